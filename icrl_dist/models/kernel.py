"""The functions of the compiled decoder, ``decoder_kernel.c``, and where it decides in place of torch.

Results are equal to those of ``models.decoder`` to 1e-5, and equal bit by bit on all processors that the
kernel runs on.  It is built when the package is installed, if there is a C compiler.
"""

from __future__ import annotations

import ctypes
import platform
from collections.abc import Callable
from typing import Any, Literal

import numpy as np
from jaxtyping import Float32

from icrl_dist.config.run import ConfigError
from icrl_dist.config.sections import Decoder, ModelConfig
from icrl_dist.copies import CopiedWhole
from icrl_dist.models.compiled import LANES, WIDEST, Unusable, kinds, library


def best_decoder(model: ModelConfig) -> Literal["torch", "kernel"]:
    """What ``context.decoder = "auto"`` means here: the kernel if there is one and the model is not too wide."""
    return "kernel" if kinds() and model.width <= WIDEST else "torch"


def missing_kernel(model: ModelConfig) -> str:
    """Why ``auto`` means torch here although the model is not too wide for the kernel, and the remedy; else empty."""
    return str(why) if isinstance(why := library("decoder"), Unusable) and model.width <= WIDEST else ""


def decoder_here(decoder: Decoder, model: ModelConfig) -> Literal["torch", "kernel"]:
    """What ``context.decoder`` means here.  If it is ``kernel`` and there is none here, it means torch.

    Then outputs differ by 1e-5.  Decisions that enter a run's digests need ``require_kernel``.
    """
    return best_decoder(model) if decoder == "auto" else decoder if kinds() else "torch"


def require_kernel() -> None:
    """Raises ConfigError unless the kernel was built and this processor can run it."""
    if isinstance(why := library("decoder"), Unusable):
        raise ConfigError(
            f"context.decoder = 'kernel': on {platform.node()} the compiled decoder cannot be used: {why}; "
            "or begin a run with context.decoder = 'torch', which has other digests"
        )


class Kernel(CopiedWhole):
    """The functions of the kernel for one instruction set, ``kind``; None: the widest that this processor has.

    Raises RuntimeError if the kernel was not built or cannot be used here.
    """

    def __init__(self, kind: str | None = None) -> None:
        loaded = library("decoder")
        if isinstance(loaded, Unusable):
            raise RuntimeError(f"kernel: {loaded}")
        if kind is not None and kind not in kinds():
            raise RuntimeError(f"kernel {kind}: this processor has {', '.join(kinds())}")
        self.kind = kind or kinds()[-1]
        pointer, number = ctypes.c_void_p, ctypes.c_int

        def function(name: str, *arguments: type) -> Callable[..., None]:
            found = getattr(loaded, f"icrl_{name}_{self.kind}")
            found.argtypes, found.restype = arguments, None
            return found

        self.run = function("run", pointer, pointer, pointer, *[ctypes.c_long] * 3, number)
        self._linear = function("linear", *[pointer] * 4, *[number] * 3)
        self._softmax = function("softmax", pointer, *[number] * 3)
        loaded.icrl_work.restype = ctypes.c_long
        self.work_size = loaded.icrl_work

    def __reduce__(self) -> tuple[Any, ...]:
        return _kernel, (self.kind,)

    def linear(
        self, x: Float32[np.ndarray, "R I"], weight: Float32[np.ndarray, "I C"], bias: Float32[np.ndarray, " C"]
    ) -> np.ndarray:
        """``x @ weight + bias``; each sum over I runs in order, beginning with the bias.

        ``weight`` and ``bias`` are ``padded``, so C is a multiple of 16.  Raises ValueError for shapes that do not fit.
        """
        x = np.ascontiguousarray(x, np.float32)
        if x.shape[1:] != weight.shape[:1] or bias.shape != weight.shape[1:]:
            raise ValueError(f"{x.shape} times {weight.shape} plus {bias.shape}: the shapes do not fit")
        to = np.empty((len(x), weight.shape[1]), np.float32)
        self._linear(address(to), address(x), address(weight), address(bias), *weight.shape, len(x))
        return to

    def softmax(self, x: Float32[np.ndarray, "R C"], n: int) -> Float32[np.ndarray, "R n"]:
        """The softmax of the first n numbers of each row, in place; C is a multiple of 16."""
        self._softmax(address(x), x.shape[1], n, len(x))
        return x[:, :n]


def _kernel(kind: str) -> Kernel:
    """The kernel for this instruction set, or for one that this processor has: results are equal."""
    if not kinds():
        raise RuntimeError(
            "a pickled agent of the compiled decoder cannot be read here: install a C compiler and run `make kernel`, "
            "or pickle one of load_agent(..., decoder='torch')"
        )
    return Kernel(kind if kind in kinds() else None)


def address(array: np.ndarray) -> int:
    """Where the numbers of an array begin."""
    found: int = array.__array_interface__["data"][0]
    return found


def padded(array: np.ndarray) -> Float32[np.ndarray, "*N C"]:
    """The array with its last axis filled up with zeros to a multiple of 16."""
    used = array.shape[-1]
    wide = np.zeros((*array.shape[:-1], used + -used % LANES), np.float32)
    wide[..., :used] = array
    return wide
