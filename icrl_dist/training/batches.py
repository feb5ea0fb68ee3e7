"""Training batches: examples (D, s_query, a*) from the trajectories of each variation, with action windows."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable, Hashable, Sequence
from dataclasses import dataclass, replace
from typing import Generic, NamedTuple, Protocol, TypeVar, overload

import numpy as np
from jaxtyping import Float32, Int64, Integer

from icrl_dist.copies import NotCopied
from icrl_dist.types import Trajectory

K = TypeVar("K", bound=Hashable)


class LabelledWindows(NamedTuple):
    """R action windows of L states (zeta_h of eq. 6) with labels; in a batch, R of each context.

    ``prev_actions`` and ``prev_rewards``: the action and reward at every state, which the later states of the window see.
    """

    states: Float32[np.ndarray, "*B R L S"]
    prev_actions: Int64[np.ndarray, "*B R L"] | Float32[np.ndarray, "*B R L A"]
    prev_rewards: Float32[np.ndarray, "*B R L"]
    labels: Float32[np.ndarray, "*B R L A"]

    @classmethod
    def cut(
        cls,
        length: int,
        states: Float32[np.ndarray, "N S"],
        prev_actions: Integer[np.ndarray, " N"] | Float32[np.ndarray, "N A"],
        prev_rewards: Float32[np.ndarray, " N"],
        labels: Float32[np.ndarray, "N A"],
    ) -> LabelledWindows:
        """Consecutive steps as windows of ``length`` steps; the remainder at the end is not used."""
        used = len(prev_actions) // length * length
        columns = states, _actions(prev_actions), prev_rewards, labels
        return cls(*(c[:used].reshape(-1, length, *c.shape[1:]) for c in columns))


def _actions(actions: np.ndarray) -> np.ndarray:
    """Actions as inputs of a model: discrete ones as int64, vectors unchanged."""
    return actions if actions.dtype == np.float32 else actions.astype(np.int64)


@dataclass(frozen=True, eq=False)
class Examples:
    """Training data of one variation: episodes for contexts, labelled queries and action windows.

    Any query can be paired with any context, because a label depends only on (tau, phi).
    ``history``: a context holds the first episodes in order, as in deployment; otherwise it
    holds any episodes in any order.
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
        """The examples of these episodes and labels.  Raises ValueError without an episode or without a label."""
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
        """Size of all arrays in bytes."""
        own = (self.actions, self.observations, self.rewards, self.queries, self.labels)
        return sum(array.nbytes for array in (*own, *(self.windows or ())))


class ExamplesCache(NotCopied, Generic[K]):
    """Reads examples when they are needed; keeps the most recently used in memory, up to ``budget`` bytes."""

    instead = "it reads an open dataset; open the run folder again, and make it anew"

    def __init__(self, budget: int, read: Callable[[K], Examples]) -> None:
        self._budget, self._read = budget, read
        self._cached: OrderedDict[K, Examples] = OrderedDict()
        self.nbytes = 0

    def put(self, key: K, examples: Examples) -> None:
        """Add examples; removes the least recently used ones beyond the budget."""
        self._cached[key] = examples
        self.nbytes += examples.nbytes
        while self.nbytes > self._budget and len(self._cached) > 1:
            _, oldest = self._cached.popitem(last=False)
            self.nbytes -= oldest.nbytes

    def get(self, key: K) -> Examples:
        """The examples of this key; read if they are not in memory."""
        if key in self._cached:
            self._cached.move_to_end(key)
        else:
            self.put(key, self._read(key))
        return self._cached[key]


class CachedExamples(Sequence[Examples], Generic[K]):
    """The examples of some keys of a cache, as a sequence."""

    def __init__(self, cache: ExamplesCache[K], keys: Sequence[K]) -> None:
        self._cache, self._keys = cache, keys

    def __len__(self) -> int:
        return len(self._keys)

    @overload
    def __getitem__(self, index: int) -> Examples: ...

    @overload
    def __getitem__(self, index: slice) -> CachedExamples[K]: ...

    def __getitem__(self, index: int | slice) -> Examples | CachedExamples[K]:
        if isinstance(index, slice):
            return CachedExamples(self._cache, self._keys[index])
        return self._cache.get(self._keys[index])


class ExamplesSequence(Protocol):
    """Examples of many variations; an item may be read from disk when it is accessed."""

    def __len__(self) -> int: ...

    def __getitem__(self, index: int, /) -> Examples: ...


@dataclass(frozen=True)
class Pool:
    """Examples of many variations, and the share of training batches that are drawn from them."""

    share: float
    examples: ExamplesSequence
    episodes: int
    """Most episodes in a context."""


@dataclass(frozen=True, eq=False)
class TrainingBatch:
    """B contexts of up to T transitions, zero-padded at the end, with N queries and R action windows each.

    Padding needs no mask: tokens attend only to earlier ones, and ``prefix`` is at most the length of
    a context without its padding.
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
    """A training batch: random variations, and random contexts, prefixes, queries and windows of each.

    A batch comes from one pool, drawn by share.  All of its contexts have the same random number of
    episodes (at most those of the variation), so there is little padding.  It has ``batch`` contexts,
    or fewer if ``transitions`` is above 0: then at most that many transitions, but at least one context.
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

    query_states, labels, prefix = (np.stack([row[column] for row in rows]) for column in (4, 5, 6))
    made = TrainingBatch(padded(0), padded(1), padded(2), padded(3), query_states, labels, prefix)
    if windows:
        drawn = [_windows(rng, examples, length, windows) for examples, length in zip(chosen, lengths, strict=True)]
        columns = (np.stack(column) for column in zip(*(cut for cut, _ in drawn), strict=True))
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
    """Random windows, and a random prefix of the context for each.  Raises ValueError if there are no windows."""
    found = examples.windows
    if found is None or not len(found.states):
        raise ValueError(
            f"optim.windows = {count}: the dataset holds no action windows; "
            "set optim.windows = 0, or collect a dataset with pretrain.windows"
        )
    chosen = rng.integers(0, len(found.states), size=count)
    return LabelledWindows(*(column[chosen] for column in found)), rng.integers(0, length + 1, size=count)
