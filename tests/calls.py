"""Functions in place of others that keep what they are called with, or what they return."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any


def noting(notes: list[Any], note: Callable[..., Any], real: Callable[..., Any]) -> Callable[..., Any]:
    """``real``, but each call first appends ``note(*arguments)`` to ``notes``."""

    def call(*arguments: Any, **more: Any) -> Any:
        notes.append(note(*arguments, **more))
        return real(*arguments, **more)

    return call


def keeping(results: list[Any], real: Callable[..., Any]) -> Callable[..., Any]:
    """``real``, but each call appends what it returns to ``results``."""

    def call(*arguments: Any, **more: Any) -> Any:
        results.append(real(*arguments, **more))
        return results[-1]

    return call


def failing(error: BaseException | type[BaseException]) -> Callable[..., Any]:
    """A function that raises this error at each call."""

    def call(*arguments: Any, **more: Any) -> Any:
        raise error

    return call
