"""Contexts D, and how trajectories of one variation become training examples (D, s_query, a*)."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable, Hashable, Sequence
from dataclasses import dataclass, replace
from typing import Generic, NamedTuple, Protocol, TypeVar, overload

import numpy as np
from jaxtyping import Float32, Int64, Integer

from icrl_dist.types import Trajectory

K = TypeVar("K", bound=Hashable)


class LabelledWindows(NamedTuple):
    """R windows of L states, what was done and gained in them (zeta of eq. 6), and the labels; or of each of B contexts."""

    states: Float32[np.ndarray, "*B R L S"]
    taken: Int64[np.ndarray, "*B R L"] | Float32[np.ndarray, "*B R L A"]
    gained: Float32[np.ndarray, "*B R L"]
    labels: Float32[np.ndarray, "*B R L A"]

    @classmethod
    def cut(
        cls,
        length: int,
        states: Float32[np.ndarray, "N S"],
        taken: Integer[np.ndarray, " N"] | Float32[np.ndarray, "N A"],
        gained: Float32[np.ndarray, " N"],
        labels: Float32[np.ndarray, "N A"],
    ) -> LabelledWindows:
        """What happened in a row as windows of this length; what is left at the end is not used."""
        whole = len(taken) // length * length
        columns = states, _actions(taken), gained, labels
        return cls(*(c[:whole].reshape(-1, length, *c.shape[1:]) for c in columns))


def _actions(actions: np.ndarray) -> np.ndarray:
    """As a model takes them: numbers as int64, vectors as they are."""
    return actions if actions.dtype == np.float32 else actions.astype(np.int64)


@dataclass(frozen=True, eq=False)
class Examples:
    """What one variation offers to learn from: episodes for contexts, labelled queries.

    Any query of a variation goes with any context of it, for its label depends on (tau, phi)
    alone.  ``history`` says that a context must be the episodes from the first on, in order,
    as the deployed agent met them; otherwise it is any of the episodes in any order.
    """

    actions: Int64[np.ndarray, "E H"] | Float32[np.ndarray, "E H A"]
    observations: Float32[np.ndarray, "E H+1 S"]
    rewards: Float32[np.ndarray, "E H"]
    queries: Float32[np.ndarray, "Q S"]
    labels: Float32[np.ndarray, "Q A"]
    history: bool
    windows: LabelledWindows | None = None

    @classmethod
    def of(
        cls,
        episodes: Sequence[Trajectory],
        queries: Float32[np.ndarray, "Q S"],
        labels: Float32[np.ndarray, "Q A"],
        history: bool = False,
        windows: LabelledWindows | None = None,
    ) -> Examples:
        """Raises ValueError without an episode or without a label."""
        if not episodes or not len(queries):
            raise ValueError(f"examples need an episode and a label, got {len(episodes)} and {len(queries)}")
        return cls(
            _actions(np.stack([t.actions for t in episodes])),
            np.stack([t.observations for t in episodes]),
            np.stack([t.rewards for t in episodes]),
            np.asarray(queries, np.float32),
            np.asarray(labels, np.float32),
            history,
            windows,
        )

    @property
    def nbytes(self) -> int:
        own = (self.actions, self.observations, self.rewards, self.queries, self.labels)
        return sum(array.nbytes for array in (*own, *(self.windows or ())))


class Shelf(Generic[K]):
    """Examples that are read when they are needed; the last used stay in memory, up to ``budget`` bytes."""

    def __init__(self, budget: int, read: Callable[[K], Examples]) -> None:
        self._budget, self._read = budget, read
        self._kept: OrderedDict[K, Examples] = OrderedDict()
        self.nbytes = 0

    def put(self, key: K, examples: Examples) -> None:
        """Keep what was read anyway, as long as there is room."""
        self._kept[key] = examples
        self.nbytes += examples.nbytes
        while self.nbytes > self._budget and len(self._kept) > 1:
            _, oldest = self._kept.popitem(last=False)
            self.nbytes -= oldest.nbytes

    def get(self, key: K) -> Examples:
        if key in self._kept:
            self._kept.move_to_end(key)
        else:
            self.put(key, self._read(key))
        return self._kept[key]


class Shelved(Sequence[Examples], Generic[K]):
    """A row of examples on a shelf."""

    def __init__(self, shelf: Shelf[K], keys: Sequence[K]) -> None:
        self._shelf, self._keys = shelf, keys

    def __len__(self) -> int:
        return len(self._keys)

    @overload
    def __getitem__(self, index: int) -> Examples: ...

    @overload
    def __getitem__(self, index: slice) -> Shelved[K]: ...

    def __getitem__(self, index: int | slice) -> Examples | Shelved[K]:
        if isinstance(index, slice):
            return Shelved(self._shelf, self._keys[index])
        return self._shelf.get(self._keys[index])


class Offered(Protocol):
    """Examples of many variations in a row, each perhaps read from the disk when it is asked for."""

    def __len__(self) -> int: ...

    def __getitem__(self, index: int, /) -> Examples: ...


@dataclass(frozen=True)
class Pool:
    """Examples of many variations, and the share of the training batches that come from them."""

    share: float
    examples: Offered
    episodes: int
    """Episodes in a context, at most."""


@dataclass(frozen=True, eq=False)
class TrainingBatch:
    """B contexts of up to T transitions, zero-padded at the end, and N queries and R windows of each.

    Padding needs no mask: context tokens see only earlier ones, and ``prefix`` never
    reaches beyond a context's real length.
    """

    observations: Float32[np.ndarray, "B T S"]
    actions: Int64[np.ndarray, "B T"] | Float32[np.ndarray, "B T A"]
    next_observations: Float32[np.ndarray, "B T S"]
    rewards: Float32[np.ndarray, "B T"]
    queries: Float32[np.ndarray, "B N S"]
    labels: Float32[np.ndarray, "B N A"]
    prefix: Int64[np.ndarray, "B N"]
    windows: LabelledWindows | None = None
    window_prefix: Int64[np.ndarray, "B R"] | None = None


def draw(
    rng: np.random.Generator,
    pools: Sequence[Pool],
    batch: int,
    queries: int,
    transitions: int = 0,
    windows: int = 0,
) -> TrainingBatch:
    """A training batch: random variations, random contexts of them, random prefixes, queries and windows.

    A batch comes from one pool, drawn by share, and its contexts have the same drawn number of
    episodes (at most what the variation has), so little is padding.  It has ``batch`` contexts,
    or as many as make up ``transitions`` if that is above 0 and those are fewer.
    """
    shares = np.array([pool.share for pool in pools])
    pool = pools[int(rng.choice(len(pools), p=shares / shares.sum()))]
    count = int(rng.integers(1, pool.episodes + 1))
    chosen = [pool.examples[int(i)] for i in rng.integers(0, len(pool.examples), size=batch)]
    if transitions:
        longest = max(min(count, len(examples.actions)) * examples.actions.shape[1] for examples in chosen)
        chosen = chosen[: max(1, transitions // longest)]
    rows = [_context(rng, examples, count, queries) for examples in chosen]
    lengths = [len(row[1]) for row in rows]

    def padded(column: int) -> np.ndarray:
        first = rows[0][column]
        out = np.zeros((len(rows), max(lengths), *first.shape[1:]), dtype=first.dtype)
        for b, row in enumerate(rows):
            out[b, : len(row[column])] = row[column]
        return out

    asked, labels, prefix = (np.stack([row[column] for row in rows]) for column in (4, 5, 6))
    made = TrainingBatch(padded(0), padded(1), padded(2), padded(3), asked, labels, prefix)
    if windows:
        drawn = [_windows(rng, examples, length, windows) for examples, length in zip(chosen, lengths, strict=True)]
        columns = (np.stack(column) for column in zip(*(of for of, _ in drawn), strict=True))
        made = replace(made, windows=LabelledWindows(*columns), window_prefix=np.stack([prefix for _, prefix in drawn]))
    return made


def _context(rng: np.random.Generator, examples: Examples, count: int, queries: int) -> tuple[np.ndarray, ...]:
    total = len(examples.actions)
    chosen = np.arange(min(count, total)) if examples.history else rng.permutation(total)[:count]
    states = examples.observations[chosen]
    query = rng.integers(0, len(examples.queries), size=queries)
    length = len(chosen) * examples.actions.shape[1]
    return (
        states[:, :-1].reshape(length, -1),
        examples.actions[chosen].reshape(length, *examples.actions.shape[2:]),
        states[:, 1:].reshape(length, -1),
        examples.rewards[chosen].reshape(length),
        examples.queries[query],
        examples.labels[query],
        rng.integers(0, length + 1, size=queries),
    )


def _windows(rng: np.random.Generator, examples: Examples, length: int, count: int) -> tuple[LabelledWindows, np.ndarray]:
    """Random windows, and a random prefix of the context for each.  Raises ValueError if there are none."""
    of = examples.windows
    if of is None or not len(of.states):
        raise ValueError("optim.windows: these examples have none; datasets without windows cannot train model.window")
    chosen = rng.integers(0, len(of.states), size=count)
    return LabelledWindows(*(column[chosen] for column in of)), rng.integers(0, length + 1, size=count)
