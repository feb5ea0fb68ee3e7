"""The result rows of a sweep: those of each run in one file, and those of all runs in ``rows.parquet``."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from icrl_dist.results import rows
from icrl_dist.storage.files import atomic_write
from icrl_dist.sweeps.file import TRAINING
from icrl_dist.sweeps.plan import Member

if TYPE_CHECKING:
    import pyarrow as pa


def file_of(out: Path, member: Member) -> Path:
    """The file of a run's collected rows."""
    return out / "rows" / f"{member.stem}.parquet"


def collect(member: Member, results: Path, files: Mapping[str, Sequence[str]], to: Path) -> pa.Table:
    """Write the rows of a run to one file and return them.

    ``results``: the folder of its files; ``files``: for each evaluation the names of its files, in the order of the rows.
    Before them come the rows that the training wrote.  Columns ``setting``, ``variant``, ``run`` and ``evaluation`` are of
    the sweep: so a repetition gives the same rows, apart from ``written``.
    """
    import pyarrow as pa
    import pyarrow.parquet as pq

    tables = [_named(rows.read_table(results / name), member, TRAINING) for name in _of_training(results)]
    tables += [_named(rows.read_table(results / name), member, one) for one, names in files.items() for name in names]
    table = pa.concat_tables(tables or [rows.table_schema().empty_table()])
    atomic_write(to, lambda file: pq.write_table(table, file, compression="zstd"))
    return table


def _of_training(results: Path) -> list[str]:
    """The newest file of each round: a fit that was killed after it rated its labels rates them again."""
    newest = {}
    for path in sorted(results.glob("label_quality-*.parquet"), key=lambda path: path.stem.rsplit("-", 1)[-1]):
        newest[path.stem.rsplit("-", 1)[0]] = path
    paths = sorted(newest.values(), key=lambda path: path.stem.rsplit("-", 1)[-1])
    return [path.name for path in paths]


def _named(table: pa.Table, member: Member, evaluation: str) -> pa.Table:
    import pyarrow as pa

    values = {"setting": member.setting, "variant": member.variant, "run": member.name, "evaluation": evaluation}
    if member.exact:
        values["method"] = "exact"
    for name, value in values.items():
        index = table.schema.get_field_index(name)
        field = table.schema.field(index)
        table = table.set_column(index, field, pa.repeat(pa.scalar(value, field.type), len(table)))
    return table


def returns(table: pa.Table, evaluation: str) -> dict[str, float]:
    """Mean return of the newest model in the last episode of an evaluation, by p: ``{"0": 61.2, "0.2": 55.1}``.

    Of reference agents, where there is no model, that of the agent that is given the task.
    """
    frame = table.to_pandas()
    frame = frame[(frame["evaluation"] == evaluation) & (frame["suite"] == "online")]
    if frame.empty:
        return {}
    newest = frame["policy_version"].max()
    last = frame[(frame["policy_version"] == newest) & (frame["episode"] == frame["episode"].max())]
    if newest < 0 and last["ceiling"].any():
        last = last[last["ceiling"]]
    return {f"{p:g}": round(float(value), 4) for p, value in last.groupby("p")["return"].mean().items()}


def join(files: Sequence[Path], to: Path) -> int:
    """Write the rows of several files, in their order, to one file; those of one file are in memory at a time.

    Returns their number.  Raises StoreError for a file that is damaged or of another format.
    """
    import pyarrow.parquet as pq

    count = 0

    def write(target: Any) -> None:
        nonlocal count
        with pq.ParquetWriter(target, rows.table_schema(), compression="zstd") as writer:
            for path in files:
                table = rows.read_table(path)
                writer.write_table(table)
                count += len(table)

    atomic_write(to, write)
    return count
