"""The libraries of the kernels: C files of this folder, compiled when the package is installed, if there is a C compiler."""

from __future__ import annotations

import ctypes
import functools
import importlib.util
import platform
import sys
from pathlib import Path
from typing import NamedTuple

LANES = 16
"""``LANES`` of lanes.h: rows of the kernels are padded with zeros to a multiple of so many numbers."""
WIDEST = 128
"""The widest model for which the kernels are faster than torch in every case (docs/results/engine.md)."""
_BUILD = "install a C compiler and run `make kernel`, or install a wheel that was built with one"
_KINDS = {"x86_64": ("avx2", "avx512"), "aarch64": ("neon",), "arm64": ("neon",)}
"""The instruction sets that the C files name, by machine, each including the ones before it."""


class Unusable(NamedTuple):
    """Why a library cannot be used here."""

    why: str
    remedy: str

    def __str__(self) -> str:
        return f"{self.why}: {self.remedy}"


@functools.cache
def library(name: str) -> ctypes.CDLL | Unusable:
    """The library of a kernel, ``decoder`` or ``training``, or why it cannot be used here."""
    found = importlib.util.find_spec(f"{__package__}._{name}_kernel")
    if found is None or found.origin is None:
        return Unusable("not compiled", _BUILD)
    return _load(Path(found.origin), [Path(__file__).with_name(source) for source in (f"{name}_kernel.c", "lanes.h")])


def _load(file: Path, sources: list[Path]) -> ctypes.CDLL | Unusable:
    try:
        if not _is_whole(file, sources):
            return Unusable(f"{file} is incomplete, or was built from other C files than those beside it", _BUILD)
        loaded = ctypes.CDLL(str(file))
        count = loaded.icrl_kinds()
    except (OSError, AttributeError) as error:
        return Unusable(f"{file} cannot be loaded ({error})", _BUILD)
    if not _KINDS.get(platform.machine(), ())[:count]:
        return Unusable(f"this processor ({platform.machine()}) has neither AVX2 with FMA nor NEON", "let torch decide")
    return loaded


def _is_whole(file: Path, sources: list[Path]) -> bool:
    """Whether a library holds its own sources, as they are now.

    A compiler for Linux puts them after everything that is loaded.  So a file that was cut is found too; loading it would
    end the process by a bus error.
    """
    content = file.read_bytes()
    return sys.platform != "linux" or all(source.read_bytes() in content for source in sources)


@functools.cache
def kinds(name: str = "decoder") -> tuple[str, ...]:
    """The instruction sets that a kernel can use on this processor, the widest last; none if it cannot be used."""
    found = library(name)
    return () if isinstance(found, Unusable) else _KINDS.get(platform.machine(), ())[: found.icrl_kinds()]
