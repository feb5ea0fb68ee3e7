"""Result rows of many runs as arrays, read in batches: one ``Arm`` for each agent, variant, setting and strength p.

A batch keeps numbers only: the strings of a row (task, adversary, agent and so on) become whole numbers while it is read, so
20 million rows need about 1 GB.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from jaxtyping import Float64, Int32

from icrl_dist.config.paths import path_of
from icrl_dist.config.run import ConfigError
from icrl_dist.results import rows
from icrl_dist.results.columns import FORMAT
from icrl_dist.results.returns import LAST
from icrl_dist.storage.files import StoreError

if TYPE_CHECKING:
    import pyarrow as pa

BUDGETS = ("environment_steps", "labelled_episodes", "optimizer_steps")
"""Columns that must be equal for methods that are compared."""
SUITES = ("online", "offline")
_BATCH = 1 << 17
_ARM = ("problem", "setting", "variant", "method", "adversaries", "suite", "agent", "deployment", "data", "prior", "p")
_PART = ("training_seed", "split_seed", "run", "evaluation", "weights_digest", "training_episodes", "label_source", *BUDGETS)
_TASK = ("task",)
_ADVERSARY = ("adversary_family", "adversary")
_PLACE = ("task_index", "evaluation_seed", "episode")
_VALUES = ("return", "certified")
_COLUMNS = tuple(dict.fromkeys((*_ARM, *_PART, *_TASK, *_ADVERSARY, *_PLACE, *_VALUES)))


class Key(NamedTuple):
    """Columns of result rows by which arms differ."""

    problem: str
    setting: str
    variant: str
    method: str
    adversaries: int | None
    suite: str
    agent: str
    deployment: str
    data: str
    prior: str
    p: float


class Part(NamedTuple):
    """One training of an arm: columns that are equal in all of its rows, and where its rows are."""

    training_seed: int
    split_seed: int | None
    run: str
    evaluation: str
    weights_digest: str
    training_episodes: int | None
    label_source: str | None
    environment_steps: int | None
    labelled_episodes: int | None
    optimizer_steps: int | None
    rows: np.ndarray


@dataclass(frozen=True, eq=False)
class Arm:
    """The rows of one agent of one variant at one p: S trainings, C tasks, E evaluations of each, N episodes an evaluation."""

    key: Key
    parts: tuple[Part, ...]
    """One per training, by training seed."""
    returns: Float64[np.ndarray, "S C E N"]
    certified: Float64[np.ndarray, "S C E N"]
    """Certified return of each episode; nan where it is not known."""
    tasks: Int32[np.ndarray, "S C"]
    """A number for each task; equal numbers are equal tasks, in all arms of one reading."""
    adversaries: Int32[np.ndarray, "S C E"]
    """The same for adversaries."""

    @property
    def seeds(self) -> tuple[int, ...]:
        """Training seeds, ascending."""
        return tuple(part.training_seed for part in self.parts)

    @property
    def crossed(self) -> bool:
        """Whether all trainings were evaluated on the same tasks."""
        return bool((self.tasks == self.tasks[:1]).all())

    @property
    def shared_splits(self) -> bool:
        """Whether trainings have the same split of the tasks, as far as their splits are known."""
        known = [part.split_seed for part in self.parts if part.split_seed is not None]
        return len(set(known)) < len(known)

    def scores(self, episodes: int = LAST) -> Float64[np.ndarray, "S C E"]:
        """Mean return over the last episodes of each evaluation."""
        return np.asarray(self.returns[..., -episodes:].mean(axis=-1))

    def worst(self, episodes: int = LAST) -> float:
        """Mean certified return over the last episodes; nan where it is not known for all of them."""
        return float(self.certified[..., -episodes:].mean())

    def only(self, seeds: Sequence[int]) -> Arm:
        """The arm with the trainings of these seeds."""
        kept = [i for i, seed in enumerate(self.seeds) if seed in seeds]
        arrays = {name: getattr(self, name)[kept] for name in ("returns", "certified", "tasks", "adversaries")}
        return replace(self, parts=tuple(self.parts[i] for i in kept), **arrays)


class Rows:
    """The arms of some files of result rows.  ``keys``: of all arms, in the order of the files."""

    def __init__(self, files: Sequence[Path]):
        """Read the files in batches.

        Raises StoreError for a file that is damaged or of another format, ConfigError for rows without a run of their own.
        """
        self.files = tuple(files)
        coded = _Coded(files)
        self._columns = coded.columns
        self._parts: dict[Key, dict[int, Part]] = {}
        for values, places in coded.groups():
            key = Key(*values[: len(_ARM)])
            part = Part(*(*values[len(_ARM) :], places))
            self._add(key, part)
        self.keys = tuple(self._parts)
        self._arms: dict[Key, Arm] = {}

    def _add(self, key: Key, part: Part) -> None:
        """Keep one evaluation of a training, by ``_newer``; refuse a second training of the same seed."""
        known = self._parts.setdefault(key, {})
        other = known.get(part.training_seed)
        if other is not None and (other.run, other.weights_digest) != (part.run, part.weights_digest):
            what = "run" if other.run != part.run else "weights_digest"
            raise ConfigError(
                f"result rows of {named(key)}, agent {key.agent}, training seed {part.training_seed}: {what} is "
                f"{getattr(other, what)} and {getattr(part, what)}: give rows of one run for each variant and seed"
            )
        if other is None or _newer(other) < _newer(part):
            known[part.training_seed] = part

    def seeds(self, key: Key) -> tuple[int, ...]:
        """The training seeds of an arm, ascending."""
        return tuple(sorted(self._parts[key]))

    def arm(self, key: Key) -> Arm:
        """The arrays of an arm.  Raises ConfigError unless its rows are one return for each place of the grid."""
        if key not in self._arms:
            self._arms[key] = self._made(key)
        return self._arms[key]

    def _made(self, key: Key) -> Arm:
        parts = tuple(part for _, part in sorted(self._parts[key].items()))
        found: list[dict[str, np.ndarray]] = []
        for part in parts:
            found.append(self._grid(key, part))
            if (here := found[-1]["return"].shape) != (first := found[0]["return"].shape):
                raise ConfigError(
                    f"result rows of {named(key)}, agent {key.agent}, p = {key.p:g}: training seed {parts[0].training_seed} "
                    f"has {_size(first)}, and seed {part.training_seed} has {_size(here)}: evaluate all seeds alike"
                )
        arrays = {name: np.stack([one[name] for one in found]) for name in found[0]}
        tasks, adversaries = arrays["task"][..., 0, 0], arrays["adversary"][..., 0]
        return Arm(key, parts, arrays["return"], arrays["certified"], tasks, adversaries)

    def _grid(self, key: Key, part: Part) -> dict[str, np.ndarray]:
        """The columns of one training by task, evaluation and episode."""
        places = [self._columns[name][part.rows] for name in _PLACE]
        levels = [np.unique(place) for place in places]
        shape = tuple(map(len, levels))
        flat = np.ravel_multi_index([np.searchsorted(*pair) for pair in zip(levels, places, strict=True)], shape)
        if len(flat) != np.prod(shape) or len(np.unique(flat)) != len(flat):
            raise ConfigError(
                f"result rows of {named(key)}, agent {key.agent}, p = {key.p:g}, training seed {part.training_seed}: "
                f"{len(flat)} rows for {_size(shape)}, where there should be one for each: give whole evaluations"
            )
        order = np.argsort(flat)
        return {
            name: self._columns[name][part.rows][order].reshape(shape) for name in ("return", "certified", "task", "adversary")
        }


def named(key: Key) -> str:
    """The setting and the variant of an arm, as messages name them: SETTING/VARIANT."""
    return f"{key.setting}/{key.variant}" if key.setting else key.variant


def _size(shape: Sequence[int]) -> str:
    return "{} tasks, {} evaluations, {} episodes".format(*shape)


def _newer(part: Part) -> tuple[str, int, str]:
    """Orders evaluations of one agent: by time in a run folder; in a sweep, which has no times, by the number of rows."""
    time = re.search(r"\d{8}T[\d.]+Z$", part.evaluation)
    return time[0] if time else "", len(part.rows), part.evaluation


def files_of(sources: str | Path | Sequence[str | Path]) -> list[Path]:
    """The files of result rows of some sources: a file, a run folder, or the folder of a sweep (its ``rows.parquet``).

    Raises ConfigError for a source without rows and for a run that is not finished.
    """
    found: dict[Path, None] = {}
    for one in [sources] if isinstance(sources, str | Path) else sources:
        path = path_of("rows", one)
        if path.is_dir() and (path / "rows.parquet").is_file():
            path = path / "rows.parquet"
        if path.is_file():
            found[path] = None
            continue
        if not path.is_dir():
            raise ConfigError(f"{path}: no such file or folder; name a file of result rows, a run folder, or a sweep's folder")
        if rows.is_unfinished(path):
            raise ConfigError(f"{path}: this run is not finished: continue it with `icrl-dist train --resume {path}`")
        inside = sorted((path / "results").glob("*.parquet"))
        if not inside:
            raise ConfigError(f"{path}: holds no result rows; `icrl-dist evaluate {path}` writes some")
        found |= dict.fromkeys(inside)
    if not found:
        raise ConfigError("report: no rows were given; name a file of result rows, a run folder, or a sweep's folder")
    return list(found)


class _Coded:
    """The columns of the files as numbers: rows with equal values of some columns have equal numbers."""

    def __init__(self, files: Sequence[Path]):
        self._known: dict[str, dict[tuple[Any, ...], int]] = {"group": {}, "task": {}, "adversary": {}}
        chunks: dict[str, list[np.ndarray]] = {}
        for path in files:
            for batch in batches(path, _COLUMNS, SUITES):
                for name, values in self._numbers(path, batch).items():
                    chunks.setdefault(name, []).append(values)
        if not chunks:
            raise ConfigError(f"{files[0]}: holds no rows of the suites online and offline; `icrl-dist evaluate` writes some")
        self.columns = {name: np.concatenate(chunks.pop(name)) for name in list(chunks)}

    def _numbers(self, path: Path, batch: pa.RecordBatch) -> dict[str, np.ndarray]:
        numbers = {name: batch.column(name).to_numpy(zero_copy_only=False) for name in (*_PLACE, *_VALUES)}
        if wrong := int((~np.isfinite(numbers["return"])).sum()):
            raise StoreError(f"{path}: return is no finite number in {wrong} rows: move the file away, and evaluate again")
        return {
            "group": self._codes("group", batch, (*_ARM, *_PART)),
            "task": self._codes("task", batch, _TASK),
            "adversary": self._codes("adversary", batch, _ADVERSARY),
            **{name: numbers[name].astype(np.int32) for name in _PLACE},
            **{name: numbers[name].astype(float) for name in _VALUES},
        }

    def _codes(self, kind: str, batch: pa.RecordBatch, columns: Sequence[str]) -> np.ndarray:
        """A number for each row, equal for equal values of these columns, in all batches."""
        code, values = np.zeros(len(batch), np.int64), []
        for name in columns:
            coded = batch.column(name).dictionary_encode(null_encoding="encode")
            values.append((coded.dictionary.to_pylist(), coded.indices.to_numpy()))
            if len(values[-1][0]) > 1:
                _, code = np.unique(code * len(values[-1][0]) + values[-1][1], return_inverse=True)
        _, first, code = np.unique(code, return_index=True, return_inverse=True)
        known = self._known[kind]
        rows_of = [tuple(texts[places[i]] for texts, places in values) for i in first]
        return np.array([known.setdefault(row, len(known)) for row in rows_of], np.int32)[code]

    def groups(self) -> Iterator[tuple[tuple[Any, ...], np.ndarray]]:
        """The values of the columns of ``_ARM`` and ``_PART``, and the numbers of the rows that have them."""
        codes = self.columns.pop("group")
        order = np.argsort(codes, kind="stable")
        starts = np.searchsorted(codes[order], np.arange(len(self._known["group"]) + 1))
        for values, start, stop in zip(self._known["group"], starts, starts[1:], strict=False):
            yield values, order[start:stop]


def batches(path: Path, columns: Sequence[str], suites: Sequence[str]) -> Iterator[pa.RecordBatch]:
    """Columns of the rows of some suites in batches; of suites of evaluations only those with a p.

    Raises StoreError for a file that is damaged or of another format.
    """
    import pyarrow as pa
    import pyarrow.dataset
    import pyarrow.parquet

    try:
        former = rows.check_schema(path, pa.parquet.read_schema(path)) != str(FORMAT)
        wanted = pa.dataset.field("suite").isin(suites)
        wanted = wanted & pa.dataset.field("p").is_valid() if suites == SUITES else wanted
        data = pa.dataset.dataset(rows.read_table(path)) if former else pa.dataset.dataset(path, format="parquet")
        scanner = data.scanner(list(columns), filter=wanted, batch_size=_BATCH, batch_readahead=2, fragment_readahead=1)
        yield from (batch for batch in scanner.to_batches() if len(batch))
    except (OSError, pa.ArrowException) as error:
        reason = " ".join(str(error).split())
        raise StoreError(f"{path}: not a file of result rows ({reason}): move it away, and evaluate again") from None
