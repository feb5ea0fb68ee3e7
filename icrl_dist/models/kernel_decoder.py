"""The deployed trunk by the compiled decoder: ``models.decoder.Decoder`` on numpy, without torch."""

from __future__ import annotations

import ctypes
import threading
from collections.abc import Mapping, Sequence
from typing import Any, Self

import numpy as np
from jaxtyping import Float32

from icrl_dist.copies import CopiedWhole
from icrl_dist.models.compiled import LANES
from icrl_dist.models.kernel import Kernel, address, padded

_BLOCKS = 8
_CHUNK = LANES * _BLOCKS
_NEAR = 1 << 19
"""Bytes of contexts that are taken to stay in the processor's second-level cache from one decision to the next."""

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
        ("far_away", ctypes.c_int32),
    ]


class KernelDecoder(CopiedWhole):
    """``models.decoder.Decoder`` by the kernel: B growing contexts, float32, one thread.

    ``weights``: those of ``models.gpt.GPT``, by their names there.  They are copied.  Calls from several threads are
    done one after the other.  Methods raise ValueError for tokens of another shape than they name.
    """

    def __init__(self, weights: Mapping[str, np.ndarray], heads: int, batch: int, kernel: Kernel) -> None:
        """``weights`` must have the shapes of ``models.stored``.  Raises ValueError for ``batch`` below 1."""
        if batch < 1:
            raise ValueError(f"batch {batch}: expected at least 1")
        weights = {name: np.array(value) for name, value in weights.items()}
        self._made_of = weights, heads, batch, kernel
        self._batch, self._width = batch, len(weights["norm.weight"])
        self._kernel = kernel
        self._one_call = threading.Lock()
        self._kept: list[np.ndarray] = []
        """What the kernel has pointers to."""
        self._layers = len({name.split(".")[1] for name in weights if name.startswith("blocks.")})
        layers = (_Layer * self._layers)()
        for number, layer in enumerate(layers):
            self._fill(layer, {n.split(".", 2)[2]: w for n, w in weights.items() if n.startswith(f"blocks.{number}.")}, heads)
        work = np.zeros(kernel.work_size(self._width, heads), np.float32)
        self._kept.append(work)
        norm = self._pair(weights["norm.weight"], weights["norm.bias"])
        self._decoder = _Decoder(self._width, heads, self._layers, batch, layers, norm, None, address(work))
        self._address = ctypes.addressof(self._decoder)
        self._chunks: list[np.ndarray] = []
        self.length = 0
        """Tokens in each context."""
        self._written = 0
        """Places from here on hold zeros."""

    def __reduce__(self) -> tuple[Any, ...]:
        with self._one_call:
            return _decoder, (*self._made_of, [chunk.copy() for chunk in self._chunks], self.length, self._written)

    def _fill(self, layer: _Layer, block: Mapping[str, np.ndarray], heads: int) -> None:
        """The weights of one block, with W_k multiplied into the queries and W_v into the output projection.

        ``models.decoder._Layer`` does the same with torch and says why.
        """
        d = self._width
        e = d // heads
        wq, wk, wv = block["qkv.weight"].reshape(3, heads, e, d)
        bq, _, bv = block["qkv.bias"].reshape(3, heads, e)
        out = block["out.weight"].reshape(d, heads, e).transpose(1, 2, 0)
        # A query's matrix and bias, then both scaled: (heads, D + 1, D).
        query = np.stack([self._product(np.vstack([wq[h].T, bq[h]]), wk[h]) for h in range(heads)]) * np.float32(e**-0.5)
        mixed = np.concatenate([self._product(wv[h].T, out[h]) for h in range(heads)])
        passed = self._product(bv.reshape(1, d), out.reshape(d, d))[0]
        layer.norm_attention = self._pair(block["norm_attention.weight"], block["norm_attention.bias"])
        layer.query = self._pair(query[:, :-1].transpose(1, 0, 2).reshape(d, heads * d), query[:, -1].reshape(-1))
        layer.out = self._pair(mixed, block["out.bias"] + passed)
        layer.norm_mlp = self._pair(block["norm_feed.weight"], block["norm_feed.bias"])
        layer.up = self._pair(block["feed.0.weight"].T, block["feed.0.bias"])
        layer.down = self._pair(block["feed.2.weight"].T, block["feed.2.bias"])

    def _product(self, a: np.ndarray, b: np.ndarray) -> np.ndarray:
        """``a @ b``, with sums in the kernel's order."""
        wide = padded(b)
        return self._kernel.linear(a, wide, np.zeros(wide.shape[1], np.float32))[:, : b.shape[1]]

    def _pair(self, weight: np.ndarray, bias: np.ndarray) -> ctypes.Array[ctypes.c_void_p]:
        pair = [padded(weight), padded(bias)]
        self._kept += pair
        return _Pair(*map(address, pair))

    def clear(self) -> None:
        """Empty every context."""
        with self._one_call:
            self.length = 0
            self._reserve(0)

    def _reserve(self, end: int) -> None:
        """Make room for tokens at the places before ``end``; those from there on become zeros.

        They are read together with the others, with a weight of 0, and 0 times nan is nan.
        """
        if (more := -(-end // _CHUNK) - len(self._chunks)) > 0:
            shape = self._layers, self._batch, _BLOCKS, self._width, LANES
            self._chunks += [np.zeros(shape, np.float32) for _ in range(more)]  # all or, without memory, none
            self._point_to_chunks()
        # Usually as many places are written again as before: then there is nothing to clear.
        for number in range(end // _CHUNK, -(-self._written // _CHUNK)) if end < self._written else ():
            chunk, first, last = self._chunks[number], max(0, end - number * _CHUNK), self._written - number * _CHUNK
            for block in range(first // LANES, -(-min(last, _CHUNK) // LANES)):
                chunk[:, :, block, :, max(0, first - block * LANES) :] = 0
        self._written = end

    def _point_to_chunks(self) -> None:
        self._pointers = self._chunk_pointers(0)
        self._decoder.chunks = self._pointers
        self._decoder.far_away = sum(chunk.nbytes for chunk in self._chunks) > _NEAR

    def filled(self, chunks: Sequence[np.ndarray], length: int, written: int) -> Self:
        """This decoder with the contexts of another one, which it now owns."""
        self._chunks, self.length, self._written = list(chunks), length, written
        self._point_to_chunks()
        return self

    def _chunk_pointers(self, row: int) -> ctypes.Array[ctypes.c_void_p]:
        """Pointers to the chunks, from context ``row`` on."""
        places = [
            address(chunk) + layer * chunk.strides[0] + row * chunk.strides[1]
            for chunk in self._chunks
            for layer in range(self._layers)
        ]
        return (ctypes.c_void_p * len(places))(*places)

    def append(self, x: Float32[np.ndarray, "B T D"]) -> None:
        """Append embedded tokens to the contexts; each token sees its whole context up to itself."""
        self._pass(x, x.shape[1], x.shape[1])

    def query(self, x: Float32[np.ndarray, "B D"]) -> Float32[np.ndarray, "B D"]:
        """Final states of one query token per context, which sees its context and itself."""
        return self._pass(x[:, None], 0, 0)

    def window(
        self, x: Float32[np.ndarray, "B L D"], arrived: Float32[np.ndarray, "B D"] | None = None
    ) -> Float32[np.ndarray, "B D"]:
        """Final state of the last token of one window per context.

        Each token of the window sees its context, the tokens before it in the window, and itself.  A
        token ``arrived`` joins the context first.
        """
        x = x if arrived is None else np.concatenate([arrived[:, None], x], axis=1)
        return self._pass(x, x.shape[1] - 1, int(arrived is not None))

    def _pass(self, x: Float32[np.ndarray, "B T D"], first: int, joining: int) -> Float32[np.ndarray, "B D"]:
        """Pass T tokens per context through the layers; the final states of those from ``first`` on, one or none.

        The first ``joining`` tokens join the context.
        """
        x = self._tokens(x, self._batch)
        states = np.empty((self._batch, self._width), np.float32)
        with self._one_call:
            past, end = self.length, self.length + x.shape[1]
            self._reserve(end)
            self._kernel.run(self._address, address(x), address(states), past, x.shape[1], first, 0)
            self.length = past + joining
        return states

    def _tokens(self, x: np.ndarray, batch: int) -> np.ndarray:
        """Tokens as the kernel reads them, (batch, T, D)."""
        x = np.ascontiguousarray(x, np.float32)
        if x.ndim != 3 or x.shape[::2] != (batch, self._width):
            raise ValueError(f"tokens have the shape {x.shape}: expected ({batch}, T, {self._width})")
        return x

    def query_row(
        self, row: int, x: Float32[np.ndarray, "Q D"], appended: Float32[np.ndarray, "E D"]
    ) -> Float32[np.ndarray, "Q D"]:
        """Final states of Q query tokens, each of which sees the whole of context ``row`` and itself.

        They also see the ``appended`` tokens, as if these had joined the context.  The decoder does not change.
        """
        if not 0 <= row < self._batch:
            raise ValueError(f"row {row}: expected one of 0..{self._batch - 1}")
        x, appended = self._tokens(x[None], 1), self._tokens(appended[None], 1)
        new, queries = appended.shape[1], x.shape[1]
        states = np.empty((queries, self._width), np.float32)
        with self._one_call:
            past = self.length
            self._reserve(past + new + 1)
            one, chunks = _Decoder.from_buffer_copy(self._decoder), self._chunk_pointers(row)
            one.batch, one.chunks = 1, chunks
            at = ctypes.addressof(one)
            self._kernel.run(at, address(appended), address(states), past, new, new, 0)
            self._kernel.run(at, address(x), address(states), past + new, queries, 0, 1)
        return states


def _decoder(
    weights: Mapping[str, np.ndarray],
    heads: int,
    batch: int,
    kernel: Kernel,
    chunks: Sequence[np.ndarray],
    length: int,
    written: int,
) -> KernelDecoder:
    """A copy: see ``KernelDecoder.__reduce__``."""
    return KernelDecoder(weights, heads, batch, kernel).filled(chunks, length, written)
