"""beartype for jaxtyping's import hook, lenient where an annotation speaks to mypy alone."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import beartype
from beartype.door import is_bearable
from beartype.roar import BeartypeDecorHintException

# As in mypy, an int is a float.
CONF = beartype.BeartypeConf(is_pep484_tower=True)


def check(function: Callable[..., Any]) -> Callable[..., Any]:
    """The function with its arguments checked; ``Self`` and plain Protocols pass unchecked."""
    for name, hint in function.__annotations__.items():
        try:
            is_bearable(None, hint, conf=CONF)
        except BeartypeDecorHintException:
            function.__annotations__[name] = Any
    return beartype.beartype(conf=CONF)(function)
