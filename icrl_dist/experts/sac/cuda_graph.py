"""A function of fixed shapes as a CUDA graph: one launch, instead of one launch per kernel from Python."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import torch
from torch import Tensor

_WARM_UP_CALLS = 3  # before the recording, as in torch.cuda.make_graphed_callables


class GraphedCallable:
    """``function(*inputs)``, recorded at the first call and replayed at every call.

    The function must not wait for the GPU and its control flow must not depend on values on the GPU.  Its
    tensors must keep their memory: other code may change them only in place.
    """

    def __init__(self, function: Callable[..., None], changed: Sequence[Tensor]) -> None:
        """``changed``: all tensors that the function reads and changes.  The warm-up calls' changes to them are undone."""
        self._function, self._changed = function, changed
        self._inputs: list[Tensor] = []
        self._replay: Callable[[], None] | None = None

    def __call__(self, *inputs: Tensor) -> None:
        """Raises ValueError if shapes differ from those of the first call."""
        if self._replay is None:
            self._inputs = [tensor.clone() for tensor in inputs]
            self._replay = self._record()
        recorded, found = ([tuple(tensor.shape) for tensor in tensors] for tensors in (self._inputs, inputs))
        if recorded != found:
            raise ValueError(f"recorded for {recorded}, not {found}: make another graph for other shapes")
        for fixed, tensor in zip(self._inputs, inputs, strict=True):
            fixed.copy_(tensor)
        self._replay()

    def _record(self) -> Callable[[], None]:
        saved = [tensor.clone() for tensor in self._changed]
        warm_up(self._call, _WARM_UP_CALLS)
        for tensor, before in zip(self._changed, saved, strict=True):
            tensor.copy_(before)
        return record(self._call)

    def _call(self) -> None:
        self._function(*self._inputs)


def warm_up(function: Callable[[], None], times: int) -> None:
    """Call the function on a separate stream: what libraries set up at their first calls must not be recorded."""
    stream = torch.cuda.Stream()  # type: ignore[no-untyped-call]
    stream.wait_stream(torch.cuda.current_stream())
    with torch.cuda.stream(stream):
        for _ in range(times):
            function()
    torch.cuda.current_stream().wait_stream(stream)


def record(function: Callable[[], None]) -> Callable[[], None]:
    """Record the function without executing it; the returned function executes it, on the current stream."""
    graph = torch.cuda.CUDAGraph()
    with torch.cuda.graph(graph):
        function()
    return graph.replay
