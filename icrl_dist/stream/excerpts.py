"""Values and names as short text for error messages."""

from __future__ import annotations

import difflib
import reprlib
from collections.abc import Sequence

LONGEST = 80
"""Characters of a value or key that an error message shows."""


def nearest(name: str, known: Sequence[str]) -> str:
    """``; did you mean 'x'?`` if a known name is close to ``name``, else nothing."""
    close = difflib.get_close_matches(name, known, n=1) if len(name) <= LONGEST else []
    return f"; did you mean {close[0]!r}?" if close else ""


def show(value: object) -> str:
    """A value for an error message: at most one short line, however large the value is."""
    text = _SHORT.repr(value)
    return text if len(text) <= LONGEST else text[: LONGEST - 3] + "..."


class _Short(reprlib.Repr):
    def __init__(self) -> None:
        super().__init__()
        self.maxlevel = 3
        self.maxlist = self.maxtuple = self.maxdict = 16
        self.maxstring = self.maxother = LONGEST

    def repr_bytes(self, value: bytes, level: int) -> str:
        return repr(value[: self.maxstring])


_SHORT = _Short()
