"""Result rows: one row per evaluated episode, in Parquet files that are written once and never changed.

Each evaluation adds one file to ``RUN_DIR/results/``.  All tables, figures and statistics are computed from these
rows.  ``columns.COLUMNS`` documents the columns.  pyarrow and pandas are imported only
inside functions, because workers and most commands need neither.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import os
from collections.abc import Iterable, Iterator, Mapping, Sequence
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from icrl_dist.config.paths import folder_of
from icrl_dist.config.run import ConfigError
from icrl_dist.results.columns import ADDED, COLUMNS, FORMAT, FORMER
from icrl_dist.storage.files import StoreError, atomic_write
from icrl_dist.telemetry import provenance

if TYPE_CHECKING:
    import pandas as pd
    import pyarrow as pa

_FORMAT_KEY = b"icrl_dist.results.format"

Block = Mapping[str, Any]
"""Rows as columns: every value is an array with one entry per row, or one value for all rows.  ``return`` is an array."""


_MADE_BY = ("package_version", "code_digest", "commit", "instruction_set", "threads")
"""The columns that are entries of ``provenance.record``."""
REPEATED = ("run", "suite", "tasks", "agent", "deployment", "data", "p", "prior")
"""Rows of several evaluations that are equal in these columns repeat one evaluation of one agent."""
_WITHOUT_P = ("label_quality", "experts")
"""Suites whose adversaries are of training, so p is null."""


def append(folder: Path, suite: str, settings: object, blocks: Sequence[Block]) -> Path:
    """Write the rows of one evaluation to a new file in ``folder`` and return its path.

    The file's name holds the suite, the first digits of the SHA-256 of ``settings`` (JSON values), and the time; no
    existing file is replaced.  Raises StoreError if the file cannot be written, ConfigError for a return that is no finite
    number.
    """
    path, table = _made(folder, suite, settings, blocks)
    _write(path, table)
    return path


def record(
    folder: Path, suite: str, settings: object, blocks: Sequence[Block], unstored: list[StoreError] | None = None
) -> pd.DataFrame:
    """Write the rows of one evaluation as ``append`` does; returns them as ``read`` does.

    A StoreError is added to ``unstored`` if that is given, and the rows are returned all the same.
    """
    path, table = _made(folder, suite, settings, blocks)
    with keeping(unstored):
        _write(path, table)
    return _frame([table])


def _made(folder: Path, suite: str, settings: object, blocks: Sequence[Block]) -> tuple[Path, pa.Table]:
    import pyarrow as pa

    digest = hashlib.sha256(json.dumps(settings, sort_keys=True).encode()).hexdigest()[:8]
    now = datetime.now(UTC)
    while os.path.lexists(path := folder / f"{suite}-{digest}-{now:%Y%m%dT%H%M%S.%f}Z.parquet"):
        now += timedelta(microseconds=1)
    fixed = {"format": FORMAT, "evaluation": path.stem, "written": now.isoformat(), "suite": suite}
    return path, pa.concat_tables([_table({**block, **fixed, **_made_by(block)}) for block in blocks])


def _write(path: Path, table: pa.Table) -> None:
    import pyarrow.parquet as pq

    atomic_write(path, lambda file: pq.write_table(table, file, compression="zstd"))


@contextlib.contextmanager
def keeping(unstored: list[StoreError] | None) -> Iterator[None]:
    """Add the StoreError of a file that cannot be written to ``unstored``, so that results are shown anyway; None: raise it."""
    try:
        yield
    except StoreError as error:
        if unstored is None:
            raise
        unstored.append(error)


def _made_by(block: Block) -> dict[str, Any]:
    """The columns that say what wrote the rows of a block: this process."""
    import torch

    found = provenance.record(block["problem"], block["method"], torch.get_num_threads())
    return {name: found[name] for name in _MADE_BY} | {"libraries": json.dumps({**found["libraries"], **found["plugins"]})}


def table_schema() -> pa.Schema:
    """Names and types of the columns, with the number of the format."""
    import pyarrow as pa

    types = {"string": pa.string(), "int64": pa.int64(), "double": pa.float64(), "bool": pa.bool_()}
    fields = [pa.field(name, types[column.type], column.nullable) for name, column in COLUMNS.items()]
    return pa.schema(fields, metadata={_FORMAT_KEY: str(FORMAT).encode()})


def _table(block: Block) -> pa.Table:
    import pyarrow as pa

    schema, rows = table_schema(), len(block["return"])
    if unknown := block.keys() - COLUMNS.keys():
        raise KeyError(f"no columns of result rows: {', '.join(sorted(unknown))}")
    if wrong := int((~np.isfinite(block["return"])).sum()):
        agents = ", ".join(sorted(set(np.atleast_1d(block["agent"]))))
        raise ConfigError(
            f"result rows of agent {agents}: column return is no finite number in {wrong} of {rows} episodes; mend the rewards "
            f"of problem {block['problem']}"
        )
    columns = []
    for field in schema:
        value = block.get(field.name)
        if isinstance(value, np.ndarray):
            columns.append(pa.array(value, field.type, from_pandas=True))  # nan becomes null
        else:
            columns.append(pa.repeat(pa.scalar(value, field.type), rows))
        if columns[-1].null_count and not field.nullable:
            raise ValueError(f"result rows: column {field.name} has no value in {columns[-1].null_count} of {rows} rows")
    return pa.Table.from_arrays(columns, schema=schema)


def read(files: Iterable[Path]) -> pd.DataFrame:
    """All rows of some files, in the files' order.

    Raises StoreError, in one line with the remedy, for a file that is not of this format or is damaged.
    """
    return _frame([read_table(path) for path in files])


def _frame(tables: Sequence[pa.Table]) -> pd.DataFrame:
    import pyarrow as pa

    frame = pa.concat_tables(tables or [table_schema().empty_table()]).to_pandas()
    for name, column in COLUMNS.items():
        if column.nullable and column.type == "int64":
            frame[name] = frame[name].astype("Int64")
    return frame


def _newest(frame: pd.DataFrame) -> pd.DataFrame:
    """The rows of the last evaluation of each agent, as a whole: never episodes of two evaluations."""
    import pandas as pd

    order = pd.Series(pd.factorize(frame["evaluation"])[0], index=frame.index)
    last = order.groupby([frame[column] for column in REPEATED], dropna=False).transform("max")
    return frame[order == last].reset_index(drop=True)


def read_table(path: Path) -> pa.Table:
    """The rows of one file as a table of ``table_schema``.  Raises StoreError as ``read`` does."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    try:
        with path.open("rb") as file:
            table = pq.read_table(file)
    except (OSError, pa.ArrowException) as error:
        reason = " ".join(str(error).split())
        raise StoreError(f"{path}: not a file of result rows ({reason}): move it away, and evaluate again") from None
    found = check_schema(path, table.schema)
    schema = table_schema()
    for field in (one for one in schema if one.name in table.column_names):
        if not field.nullable and (missing := table.column(field.name).null_count):
            raise StoreError(
                f"{path}: {missing} of {len(table)} rows have no {field.name}, so they can be neither distinguished nor "
                "paired: move the file away, and evaluate again"
            )
    tested = ~np.isin(table.column("suite").to_numpy(), _WITHOUT_P)
    for name, needed in (("return", np.ones(len(table), bool)), ("p", tested)):
        if unknown := int((needed & ~np.isfinite(table.column(name).to_numpy())).sum()):
            raise StoreError(
                f"{path}: {name} is no finite number in {unknown} of {len(table)} rows: move the file away, and evaluate again"
            )
    table = _present(table) if found == str(FORMER) else table
    return table.select(schema.names).cast(schema)


def check_schema(path: Path, schema: pa.Schema) -> str:
    """The format of a file.  Raises StoreError, in one line with the remedy, for other formats and for wrong columns."""
    found = (schema.metadata or {}).get(_FORMAT_KEY, b"none").decode(errors="replace")
    if found not in (str(FORMAT), str(FORMER)):
        raise StoreError(
            f"{path}: result rows of format {found}, and this version reads formats {FORMER} and {FORMAT}: read them "
            "with the version that wrote them (column package_version), or move the file away and repeat `icrl-dist evaluate`"
        )
    expected = {(f.name, str(f.type)) for f in table_schema() if found == str(FORMAT) or f.name not in ADDED}
    if wrong := sorted({(field.name, str(field.type)) for field in schema} ^ expected):
        columns = ", ".join(dict.fromkeys(name for name, _ in wrong))
        raise StoreError(f"{path}: result rows with wrong columns ({columns}): move the file away, and evaluate again")
    return found


def _present(table: pa.Table) -> pa.Table:
    """Rows of format 1 with the columns of this format.

    There ``adversary_index`` is the number of the test task, whose evaluations all have the adversary of draw 0.
    """
    import pyarrow as pa

    schema, trained = table_schema(), np.isin(table.column("suite").to_numpy(), _WITHOUT_P)
    draws = pa.array(np.where(trained, table.column("adversary_index").to_numpy(), 0))
    columns = {name: pa.repeat(pa.scalar(value, schema.field(name).type), len(table)) for name, value in ADDED.items()}
    table = table.drop_columns(["adversary_index"])
    for name, column in (columns | {"variant": table.column("method"), "adversary_index": draws}).items():
        table = table.append_column(name, column)
    return table


def read_results(runs: str | Path | Sequence[str | Path], unfinished: bool = False, all: bool = False) -> pd.DataFrame:
    """The result rows of one run folder or of several, one row per evaluated episode; docs/data.md explains the columns.

    If several evaluations of a run evaluated one agent alike (equal columns ``REPEATED``), the frame holds the rows of the
    newest only.  Rows of format 1 are read as well; the columns that they lack have the values of docs/data.md.

    ``unfinished``: also read runs whose training has not finished; ``all``: the rows of all evaluations, which differ in
    the column ``evaluation``.  Raises ConfigError for a folder without results and for an unfinished run, StoreError for
    a file of another format.
    """
    import pandas as pd

    frames = []
    listed = runs if isinstance(runs, Iterable) and not isinstance(runs, str | bytes) else [runs]
    for folder in dict.fromkeys(folder_of("runs", one) for one in listed):
        if not unfinished and is_unfinished(folder):
            raise ConfigError(
                f"{folder}: this run is not finished: continue it with `icrl-dist train --resume {folder}`, "
                "or read what there is with read_results(..., unfinished=True)"
            )
        found = sorted((folder / "results").glob("*.parquet"), key=lambda path: path.stem.rsplit("-", 1)[-1])
        if not found:
            raise ConfigError(f"{folder}: holds no result rows; `icrl-dist evaluate {folder}` writes some")
        frames.append(read(found) if all else _newest(read(found)))
    return pd.concat(frames, ignore_index=True) if frames else read([])


def is_unfinished(folder: Path) -> bool:
    """Whether a run folder holds a run whose training or evaluation has not ended."""
    return (folder / "run.toml").exists() and not (folder / "result.json").exists()
