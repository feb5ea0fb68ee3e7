"""Values that users pass, as arrays of a known shape and kind: copies, whatever they were before.

Lists, numpy arrays and scalars of any number type, and torch tensors are accepted, because their meaning is clear.  All
functions raise ValueError, in one line with the argument's name, its value or shape, and what is expected.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from jaxtyping import Bool, Float32, Int64, Shaped

LARGEST = 1e12
"""Largest absolute value of an observation or a reward: squares of larger ones overflow in a network's float32."""


def floats(name: str, value: Any, shape: tuple[int | None, ...], remedy: str = "") -> Float32[np.ndarray, "..."]:
    """Finite numbers of this shape, None for any length; ``remedy``: what the message of a wrong shape adds."""
    array = _array(name, value, "fiub", "numbers", shape, remedy)
    with np.errstate(over="ignore", invalid="ignore"):
        small = np.abs(array) <= LARGEST  # False for nan
    if not small.all():
        raise ValueError(f"{name} has the value {array[~small][0]}: expected finite numbers, at most {LARGEST:g}")
    return array.astype(np.float32)


def vectors(name: str, value: Any, shape: tuple[int, ...], remedy: str = "") -> Float32[np.ndarray, "..."]:
    """Actions that are vectors of numbers in [-1, 1]."""
    array = _array(name, value, "fiu", "numbers", shape, remedy).astype(np.float32)  # 1 + 1e-9 is 1
    inside = np.abs(array) <= 1
    if not inside.all():
        raise ValueError(f"{name} has the value {array[~inside][0]}: expected numbers in [-1, 1]")
    return array


def choices(name: str, value: Any, shape: tuple[int, ...], count: int, remedy: str = "") -> Int64[np.ndarray, "..."]:
    """Actions that are numbers in 0..``count`` - 1; a float that holds such a number is one."""
    array = _array(name, value, "fiu", "whole numbers", shape, remedy)
    inside = (array >= 0) & (array < count)
    if array.dtype.kind == "f":
        inside &= array == np.floor(array)
    if not inside.all():
        raise ValueError(f"{name} has the value {array[~inside][0]}: expected one of 0..{count - 1}")
    return array.astype(np.int64)


def flags(name: str, value: Any, shape: tuple[int, ...], remedy: str = "") -> Bool[np.ndarray, "..."]:
    """True and False, or 1 and 0."""
    array = _array(name, value, "biuf", "True or False", shape, remedy)
    wrong = (array != 0) & (array != 1)
    if wrong.any():
        raise ValueError(f"{name} has the value {array[wrong][0]}: expected True or False")
    return array.astype(np.bool_)


def whole(name: str, value: Any, least: int, most: int | None = None) -> int:
    """A whole number of at least ``least`` and at most ``most``; True and False are none."""
    number = value.item() if isinstance(value, np.generic) else value
    expected = f"expected a whole number of at least {least}" if most is None else f"expected one of {least}..{most}"
    if isinstance(number, bool) or not isinstance(number, int) or number < least or (most is not None and number > most):
        raise ValueError(f"{name} = {short(value)}: {expected}")
    return number


def short(value: object) -> str:
    """The value for a message of one line."""
    text = " ".join(repr(value).split())
    return text if len(text) <= 60 else f"{text[:57]}..."


def _array(
    name: str, value: Any, kinds: str, expected: str, shape: tuple[int | None, ...], remedy: str
) -> Shaped[np.ndarray, "..."]:
    """The value as an array of one of these kinds of dtypes, and of this shape."""
    if hasattr(value, "detach"):  # a tensor, perhaps on a GPU
        value = value.detach().cpu()
    try:
        array = np.asarray(value)
    except Exception as error:  # a list of lists of different lengths, or a type of a tensor that numpy lacks
        raise ValueError(f"{name} = {short(value)}: expected {expected} ({' '.join(str(error).split())})") from None
    if array.dtype.kind not in kinds:
        raise ValueError(f"{name} = {short(value)} has the type {array.dtype}: expected {expected}")
    if len(array.shape) != len(shape) or any(n not in (None, m) for n, m in zip(shape, array.shape, strict=True)):
        wanted = f"({', '.join('any' if n is None else str(n) for n in shape)}{',' * (len(shape) == 1)})"
        raise ValueError(f"{name} has shape {array.shape}, expected {wanted}{remedy}")
    return array
