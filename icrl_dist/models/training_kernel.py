"""Loss and gradients of ``models.dpt.PretrainedTransformer`` through a compiled kernel, ``training_kernel.c``.

Equal to those of torch to 1e-4, and equal bit by bit on all processors that the kernel runs on.
"""

from __future__ import annotations

import ctypes
import itertools
import math
from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
from jaxtyping import Float32, Int32, Int64

from icrl_dist.config.sections import ModelConfig
from icrl_dist.copies import NotCopied
from icrl_dist.models.compiled import LANES, Unusable, kinds, library
from icrl_dist.models.kernel import address, padded
from icrl_dist.types import Spec

_LAYER = ("norm_attention", "qkv", "out", "norm_feed", "feed.0", "feed.2")
"""The parameters of a block, each a weight and a bias, in the order of training_kernel.c."""


class Inputs(NamedTuple):
    """B contexts of T tokens, with Q queries each, as the kernel takes them."""

    tokens: Float32[np.ndarray, "B T I"]
    """Of each transition: the inputs of ``embed_transition``, and a 1 for its bias."""
    queries: Float32[np.ndarray, "B Q J"]
    """Of each query state: the inputs of ``embed_query``, and a 1; with windows also those of ``embed_taken``, and a 1."""
    labels: Float32[np.ndarray, "B Q A"]
    length: Int32[np.ndarray, " B"]
    """The first tokens of each context that a query sees."""
    prefix: Int32[np.ndarray, "B Q"]
    """Tokens that each query sees."""
    own: Int32[np.ndarray, " Q"]
    """States of its own window that each query sees: the ones before it, and itself."""


class _Fit(ctypes.Structure):
    """``Fit`` of training_kernel.c."""

    _fields_ = [
        *((name, ctypes.c_int32) for name in ("width", "heads", "layers", "actions", "gaussian", "window")),
        *((name, ctypes.c_int32) for name in ("token_inputs", "query_inputs", "tokens", "queries")),
        *(
            (name, ctypes.c_void_p)
            for name in ("place", "weight", "back", "token", "query", "label", "length", "prefix", "own")
        ),
        ("share", ctypes.c_float),
    ]


class _Places:
    """Where the kernel has each parameter: an array of padded matrices with inputs as rows, and one of their transposes."""

    def __init__(self, spec: Spec, config: ModelConfig, shapes: Mapping[str, tuple[int, ...]]) -> None:
        """``shapes``: of the parameters in the order in which their numbers follow each other in one array."""
        sizes = [math.prod(shape) for shape in shapes.values()]
        starts = [0, *itertools.accumulate(sizes)]
        ids = {name: np.arange(a, a + n).reshape(shapes[name]) for name, a, n in zip(shapes, starts, sizes, strict=False)}
        self.factor = np.ones(starts[-1], np.float32)
        """Of each number: queries are scaled beforehand, by 1 over the square root of a head's width."""
        heads, taken = config.heads, ("embed_taken",) * (config.window > 1)
        columns = [
            _spread(_with_bias(ids, "embed_transition"), 1, 1),
            _spread(np.vstack([_with_bias(ids, name) for name in ("embed_query", *taken)]), 1, 1),
            *(_spread(ids[f"trunk.norm.{part}"], 0, 1) for part in ("weight", "bias")),
        ]
        self.token_inputs, self.query_inputs = len(columns[0]), (len(ids["embed_query.weight"].T) + 1, len(columns[1]))
        """Numbers of a token; numbers of a query of a batch without and with windows."""
        parts = 1 if spec.discrete else 2  # means and deviations are padded apart
        columns += [_spread(_spread(ids["head.weight"].T, 0, 1), 1, parts), _spread(ids["head.bias"], 0, parts)]
        for layer in range(config.layers):
            for name, inputs, outputs in zip(_LAYER, (1, 1, heads, 1, 1, 1), (1, 3 * heads, 1, 1, 1, 1), strict=True):
                weight, bias = (ids[f"trunk.blocks.{layer}.{name}.{part}"] for part in ("weight", "bias"))
                weight = _spread(weight, 0, 1) if weight.ndim == 1 else _spread(_spread(weight.T, 0, inputs), 1, outputs)
                columns += [weight, _spread(bias, 0, outputs)]
            for part in ("weight", "bias"):
                queries = ids[f"trunk.blocks.{layer}.qkv.{part}"][: config.width]
                self.factor[queries.ravel()] = 1 / math.sqrt(config.width // heads)
        self.place = np.cumsum([0, *(column.size for column in columns)])[:-1].astype(np.int64)
        self.size = sum(column.size for column in columns)
        """Numbers of the kernel's array."""
        self.forward = self._inverse(np.concatenate([column.ravel() for column in columns]), starts[-1])
        """Where the kernel has each number, by its place among the parameters."""
        self.back = self._inverse(np.concatenate([column.T.ravel() for column in columns]), starts[-1])
        """The same in the transposes."""

    @staticmethod
    def _inverse(ids: Int64[np.ndarray, " N"], count: int) -> Int64[np.ndarray, " P"]:
        found = np.empty(count, np.int64)
        used = np.flatnonzero(ids >= 0)
        found[ids[used]] = used
        return found


def _with_bias(ids: Mapping[str, np.ndarray], name: str) -> np.ndarray:
    return np.vstack([ids[f"{name}.weight"].T, ids[f"{name}.bias"]])


def _spread(ids: np.ndarray, axis: int, parts: int) -> np.ndarray:
    """The array with each of the equal parts of an axis filled up with -1 to a multiple of 16."""
    split = np.split(ids, parts, axis)
    fill = [(0, 0)] * axis + [(0, -split[0].shape[axis] % LANES)] + [(0, 0)] * (ids.ndim - axis - 1)
    return np.concatenate([np.pad(part, fill, constant_values=-1) for part in split], axis)


class TrainingKernel(NotCopied):
    """The kernel for one model and one instruction set, ``kind``; None: the widest that this processor has.

    Raises RuntimeError if the kernel was not built or cannot be used here.
    """

    instead = "it holds a compiled library; make a new one from the spec, the settings and the weights"

    def __init__(self, spec: Spec, config: ModelConfig, shapes: Mapping[str, tuple[int, ...]], kind: str | None = None) -> None:
        """``shapes``: of the parameters, in the order of the array that ``load`` takes."""
        known, built = kinds("training"), library("training")
        if isinstance(built, Unusable):
            raise RuntimeError(f"training kernel: {built}")
        if kind is not None and kind not in known:
            raise RuntimeError(f"training kernel {kind}: this processor has {', '.join(known)}")
        self._spec, self._config, self._places = spec, config, _Places(spec, config, shapes)
        self._weight, self._back = (np.zeros(self._places.size, np.float32) for _ in range(2))
        self.gradient_size = self._places.size
        """Numbers of a gradient of the kernel."""
        kind = kind or known[-1]
        pointer, long, number = ctypes.c_void_p, ctypes.c_long, ctypes.c_float
        self._fit, self._sum = getattr(built, f"icrl_fit_{kind}"), getattr(built, f"icrl_sum_{kind}")
        self._fit.argtypes, self._fit.restype = (pointer, long, pointer, pointer), number
        self._sum.argtypes, self._sum.restype = (pointer, pointer, long, long), None
        self._squares, self._orthogonal = getattr(built, f"icrl_squares_{kind}"), getattr(built, f"icrl_orthogonal_{kind}")
        self._squares.argtypes, self._squares.restype = (pointer, long), number
        self._orthogonal.argtypes, self._orthogonal.restype = (pointer, long, long, number, number, number, pointer), None
        self._work = built.icrl_fit_work
        self._work.restype = ctypes.c_long

    def load(self, parameters: Float32[np.ndarray, " P"]) -> None:
        """Take these weights for what follows."""
        scaled = parameters * self._places.factor
        self._weight[self._places.forward] = scaled
        self._back[self._places.back] = scaled

    def gradient(self, parts: Float32[np.ndarray, "G N"]) -> Float32[np.ndarray, " P"]:
        """The sum of gradients of the kernel, in order, as one number per parameter."""
        total = np.empty(parts.shape[1], np.float32)
        self._sum(address(total), address(parts), parts.shape[1], len(parts))
        found: np.ndarray = total[self._places.forward]
        found *= self._places.factor
        return found

    def norm(self, x: Float32[np.ndarray, " N"]) -> float:
        """The Euclidean norm."""
        x = padded(x)
        return math.sqrt(self._squares(address(x), len(x)))

    def orthogonal(self, x: Float32[np.ndarray, "R C"], a: float, b: float, c: float) -> Float32[np.ndarray, "R C"]:
        """Muon's five steps of Newton and Schulz, with these coefficients, for a matrix of a norm below 1."""
        wide = len(x) <= x.shape[1]
        used = x if wide else x.T
        rows, columns = used.shape
        work = np.ascontiguousarray(np.pad(used, ((0, -rows % LANES), (0, -columns % LANES))), np.float32)
        room = np.empty(2 * len(work) * sum(work.shape), np.float32)
        self._orthogonal(address(work), *work.shape, a, b, c, address(room))
        found = work[:rows, :columns]
        return found if wide else found.T


def _check(inputs: Inputs, places: _Places, spec: Spec, window: int) -> None:
    """The kernel reads and writes where the inputs say, so they are held to their shapes and bounds before."""
    contexts, count = inputs.prefix.shape
    tokens, own = inputs.tokens.shape[1], inputs.own
    expected = [(contexts, tokens, places.token_inputs), (contexts, count, spec.actions), (contexts,), (count,)]
    found = [array.shape for array in (inputs.tokens, inputs.labels, inputs.length, own)]
    if found != expected or inputs.queries.shape not in [(contexts, count, numbers) for numbers in places.query_inputs]:
        raise ValueError(f"arrays of the shapes {[array.shape for array in inputs]}: not those of a batch of this model")
    if (inputs.prefix < 0).any() or (inputs.prefix > inputs.length[:, None]).any() or inputs.length.max() > tokens:
        raise ValueError(f"prefixes of {inputs.prefix.min()} to {inputs.prefix.max()}: a context has {tokens} tokens")
    if (own < 1).any() or (own > np.arange(1, count + 1)).any() or own.max() > window:
        raise ValueError(f"windows of up to {own.max()} states: model.window = {window}")


class Contexts:
    """The contexts of one batch, whose losses and gradients the kernel computes one at a time, from any thread."""

    def __init__(self, kernel: TrainingKernel, inputs: Inputs) -> None:
        """Raises ValueError for inputs of another model, and for prefixes and windows that do not fit the contexts."""
        spec, config = kernel._spec, kernel._config
        _check(inputs, kernel._places, spec, config.window)
        labels = padded(inputs.labels)
        tokens, states = (np.ascontiguousarray(array, np.float32) for array in (inputs.tokens, inputs.queries))
        numbers = [np.ascontiguousarray(array, np.int32) for array in (inputs.length, inputs.prefix, inputs.own)]
        self._kept: list[np.ndarray] = [kernel._places.place, kernel._weight, kernel._back, tokens, states, labels, *numbers]
        """What the kernel has pointers to."""
        contexts, queries = inputs.prefix.shape
        self.labels = contexts * queries
        """Number of labels: the loss of a batch is a mean over them."""
        sizes = config.width, config.heads, config.layers, spec.actions
        shapes = inputs.tokens.shape[2], inputs.queries.shape[2], inputs.tokens.shape[1], queries
        pointers = [address(array) for array in self._kept]
        self._fit = _Fit(*sizes, not spec.discrete, config.window, *shapes, *pointers, 1 / self.labels)
        self._at, self._run = ctypes.addressof(self._fit), kernel._fit
        longest = int(inputs.length.max())
        self.work_size: int = kernel._work(*sizes, longest, queries, config.window)
        """Numbers of scratch memory that ``add`` needs."""

    def add(self, context: int, gradient: Float32[np.ndarray, " N"], work: Float32[np.ndarray, " W"]) -> float:
        """Add the gradient of one context to ``gradient``; returns the sum of the losses of its queries."""
        loss: float = self._run(self._at, context, address(gradient), address(work))
        return loss
