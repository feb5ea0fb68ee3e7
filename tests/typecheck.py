"""beartype and jaxtyping at every call, lenient where an annotation is only for mypy.

jaxtyping's own decorator checks the arguments of every function twice and binds them to names
first, whether or not there are arrays among them: most of the time of a whole run in a test.
"""

from __future__ import annotations

import dataclasses
import inspect
import typing
from collections.abc import Callable
from types import FunctionType, SimpleNamespace
from typing import Any

import beartype
import jaxtyping
from beartype.door import is_bearable
from beartype.roar import BeartypeDecorHintException

# As in mypy, an int is a float.
CONF = beartype.BeartypeConf(is_pep484_tower=True, violation_type=jaxtyping.TypeCheckError)

_shapes = jaxtyping.jaxtyped


def install(package: str) -> None:
    """Check every call of what is imported from the package from now on."""
    jaxtyping.jaxtyped = _checked  # type: ignore[assignment]  # the import hook puts it before every function and class
    jaxtyping.install_import_hook(package, None)


def _checked(thing: Any = None, *, typechecker: None = None) -> Any:
    if thing is None:
        return _checked
    if isinstance(thing, FunctionType):
        return _check(thing)
    has_own_init = dataclasses.is_dataclass(thing) and "__init__" in vars(thing)
    if has_own_init:
        thing.__init__ = _check(thing.__init__)
    return thing


def _check(function: FunctionType) -> Callable[..., Any]:
    """The function with its arguments checked, shapes too; ``Self`` and plain Protocols pass unchecked."""
    hints = {name: _resolved(hint, function.__globals__) for name, hint in function.__annotations__.items()}
    if inspect.isgeneratorfunction(function):
        hints.pop("return", None)
    function.__annotations__ = hints
    checked = beartype.beartype(conf=CONF)(function)
    return _shapes(checked, typechecker=None) if any(map(_has_arrays, hints.values())) else checked


def _resolved(hint: Any, names: dict[str, Any]) -> Any:
    """What the annotation stands for; Any if it is imported, or made, only for mypy."""
    try:
        found = typing.get_type_hints(SimpleNamespace(__annotations__={"it": hint}), names, include_extras=True)["it"]
        is_bearable(None, found, conf=CONF)
    except (NameError, BeartypeDecorHintException):
        return Any
    return found


def _has_arrays(hint: Any) -> bool:
    if inspect.isclass(hint) and issubclass(hint, jaxtyping.AbstractArray):
        return True
    return any(map(_has_arrays, hint if isinstance(hint, list) else typing.get_args(hint)))
