"""Work of fixed shapes as a CUDA graph: launched as one, instead of kernel by kernel from Python."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import torch
from torch import Tensor

_WARM = 3  # calls before the recording, as torch.cuda.make_graphed_callables makes


class Graphed:
    """``work(*given)``, recorded at the first call and played back at every call.

    ``work`` may neither wait for the GPU nor depend on numbers that are on it, and always finds its
    own tensors in the same place: who changes them from outside changes them in place.
    """

    def __init__(self, work: Callable[..., None], changed: Sequence[Tensor]) -> None:
        """``changed`` is all that ``work`` reads and leaves changed: the calls before the recording are undone there."""
        self._work, self._changed = work, changed
        self._given: list[Tensor] = []
        self._replay: Callable[[], None] | None = None

    def __call__(self, *given: Tensor) -> None:
        """Raises ValueError for other shapes than those of the first call."""
        if self._replay is None:
            self._given = [one.clone() for one in given]
            self._replay = self._recorded()
        if [one.shape for one in given] != [one.shape for one in self._given]:
            raise ValueError(f"recorded for {[tuple(one.shape) for one in self._given]}, not {[tuple(o.shape) for o in given]}")
        for mine, theirs in zip(self._given, given, strict=True):
            mine.copy_(theirs)
        self._replay()

    def _recorded(self) -> Callable[[], None]:
        kept = [one.clone() for one in self._changed]
        warm(self._call, _WARM)
        for one, before in zip(self._changed, kept, strict=True):
            one.copy_(before)
        return record(self._call)

    def _call(self) -> None:
        self._work(*self._given)


def warm(work: Callable[[], None], times: int) -> None:
    """Do the work on a stream of its own: what libraries set up at their first calls must not be recorded."""
    aside = torch.cuda.Stream()  # type: ignore[no-untyped-call]
    aside.wait_stream(torch.cuda.current_stream())
    with torch.cuda.stream(aside):
        for _ in range(times):
            work()
    torch.cuda.current_stream().wait_stream(aside)


def record(work: Callable[[], None]) -> Callable[[], None]:
    """Record the work without doing it; the function that is returned does it, on the current stream."""
    graph = torch.cuda.CUDAGraph()
    with torch.cuda.graph(graph):
        work()
    return graph.replay
