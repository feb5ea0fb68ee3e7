"""The decoder of ``models.decoder`` through a compiled kernel: ``decoder_kernel.c``, built when the package is.

Results are equal to torch's to 1e-5, and equal bit by bit on all processors that the kernel runs on.
"""

from __future__ import annotations

import ctypes
import functools
import importlib.util
from typing import cast

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn import functional as F

from icrl_dist.models.decoder import Linear, layers_of, weight_and_bias
from icrl_dist.models.gpt import GPT

_LANES = 16
_BLOCKS = 4
_CHUNK = _LANES * _BLOCKS
_KINDS = {"x86_64": ("avx2", "avx512"), "aarch64": ("neon",)}

_Pair = ctypes.c_void_p * 2


class _Layer(ctypes.Structure):
    """``Layer`` of decoder_kernel.c."""

    _fields_ = [(name, _Pair) for name in ("norm_attention", "query", "out", "norm_mlp", "up", "down")]


class _Decoder(ctypes.Structure):
    """``Decoder`` of decoder_kernel.c."""

    _fields_ = [
        *((name, ctypes.c_int32) for name in ("width", "heads", "layers", "batch")),
        ("layer", ctypes.POINTER(_Layer)),
        ("norm", _Pair),
        ("chunks", ctypes.POINTER(ctypes.c_void_p)),
        ("work", ctypes.c_void_p),
    ]


@functools.cache
def library() -> ctypes.CDLL | None:
    """The compiled kernel; None where it was not built."""
    found = importlib.util.find_spec("icrl_dist.models._decoder_kernel")
    return None if found is None or found.origin is None else ctypes.CDLL(found.origin)


@functools.cache
def kinds() -> tuple[str, ...]:
    """The instruction sets for which the kernel was built and which this processor has, the best one last."""
    import platform

    built = library()
    return () if built is None else _KINDS.get(platform.machine(), ())[: built.icrl_kinds()]


class KernelDecoder:
    """``models.decoder.Decoder``, through the kernel: one fused pass, float32 on a CPU, one thread."""

    def __init__(self, trunk: GPT, batch: int, kind: str | None = None) -> None:
        built = library()
        assert built is not None, "the kernel was not built"
        self._run = getattr(built, f"icrl_run_{kind or kinds()[-1]}")
        self._run.argtypes = [ctypes.c_void_p] * 3 + [ctypes.c_long] * 3 + [ctypes.c_int]
        self._run.restype = None
        self._batch, self._width = batch, trunk.norm.normalized_shape[0]
        with torch.no_grad():
            layers = layers_of(trunk)
            self._kept: list[Tensor] = []
            """What the kernel has pointers to."""
            pointers = (_Layer * len(layers))()
            for to, layer in zip(pointers, layers, strict=True):
                for name, of in zip(("norm_attention", "query", "out", "norm_mlp", "up", "down"), layer[1:], strict=True):
                    setattr(to, name, self._pointers(cast(Linear, of)))
            work = torch.zeros(built.icrl_work(self._width, layers[0].heads))
            self._kept.append(work)
            self._layers = len(layers)
            self._decoder = _Decoder(
                self._width, layers[0].heads, len(layers), batch, pointers, self._pointers(weight_and_bias(trunk.norm)), None, work.data_ptr()
            )
        self._address = ctypes.addressof(self._decoder)
        self._chunks: list[Tensor] = []
        self.length = 0
        """Tokens in each context."""

    def _pointers(self, of: Linear) -> ctypes.Array[ctypes.c_void_p]:
        """Weight and bias as the kernel reads them: inputs as rows, columns padded with zeros."""
        tensors = [F.pad(t, (0, -t.shape[-1] % _LANES)).contiguous() for t in (of[0].T, of[1])]
        self._kept += tensors
        return _Pair(*(t.data_ptr() for t in tensors))

    def clear(self) -> None:
        """Empty every context."""
        self.length = 0

    def _reserve(self, tokens: int) -> None:
        """Make room for contexts of that many tokens."""
        if len(self._chunks) * _CHUNK >= tokens:
            return
        while len(self._chunks) * _CHUNK < tokens:
            # Zeros: lanes without a token are multiplied by a weight of 0.
            self._chunks.append(torch.zeros(self._layers, self._batch, _BLOCKS, self._width, _LANES))
        self._pointers_to_chunks = self._chunk_pointers(0)
        self._decoder.chunks = self._pointers_to_chunks

    def _chunk_pointers(self, row: int) -> ctypes.Array[ctypes.c_void_p]:
        """Pointers to the chunks, from context ``row`` on."""
        places = [chunk[layer, row].data_ptr() for chunk in self._chunks for layer in range(self._layers)]
        return (ctypes.c_void_p * len(places))(*places)

    def append(self, x: Float[Tensor, "B T D"]) -> None:
        """Append embedded tokens to the contexts; each token sees its whole context up to itself."""
        new = x.shape[1]
        self._reserve(self.length + new)
        x = x.contiguous()
        self._run(self._address, x.data_ptr(), None, self.length, new, new, 0)
        self.length += new

    def query(self, x: Float[Tensor, "B D"]) -> Float[Tensor, "B D"]:
        """Final states of one query token per context, which sees its context and itself."""
        self._reserve(self.length + 1)
        x, states = x.contiguous(), torch.empty(self._batch, self._width)
        self._run(self._address, x.data_ptr(), states.data_ptr(), self.length, 1, 0, 0)
        return states

    def window(self, x: Float[Tensor, "B L D"], arrived: Float[Tensor, "B D"] | None = None) -> Float[Tensor, "B D"]:
        """Final state of the last token of one window per context.

        Each token of the window sees its context, the tokens before it in the window, and itself.  A
        token ``arrived`` joins the context first.
        """
        new = int(arrived is not None)
        x = (x if arrived is None else torch.cat([arrived[:, None], x], dim=1)).contiguous()
        tokens, states = x.shape[1], torch.empty(self._batch, self._width)
        self._reserve(self.length + tokens)
        self._run(self._address, x.data_ptr(), states.data_ptr(), self.length, tokens, tokens - 1, 0)
        # The window's tokens stay in the chunks, after the end of the context: the next ones overwrite them.
        self.length += new
        return states

    def query_row(self, row: int, x: Float[Tensor, "Q D"], appended: Float[Tensor, "E D"]) -> Float[Tensor, "Q D"]:
        """Final states of Q query tokens, each of which sees the whole of context ``row`` and itself.

        They also see the ``appended`` tokens, as if these had joined the context.  The decoder does not change.
        """
        new, queries = len(appended), len(x)
        self._reserve(self.length + new + 1)
        one, chunks = _Decoder.from_buffer_copy(self._decoder), self._chunk_pointers(row)
        one.batch, one.chunks = 1, chunks
        address, states = ctypes.addressof(one), torch.empty(queries, self._width)
        x, appended = x.contiguous(), appended.contiguous()
        if new:
            self._run(address, appended.data_ptr(), None, self.length, new, new, 0)
        self._run(address, x.data_ptr(), states.data_ptr(), self.length + new, queries, 0, 1)
        return states
