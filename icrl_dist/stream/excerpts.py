"""Text and values from outside as short text: for error messages, terminals, pages and log files."""

from __future__ import annotations

import difflib
import reprlib
import unicodedata
from collections.abc import Sequence

LONGEST = 80
"""Characters of a value or key that an error message shows."""


def plain(text: str, longest: int = 200) -> str:
    """Text from outside as one line of at most ``longest`` characters that any terminal, page or file can show.

    Text from outside is every text that another process, a file or a file's name can choose.  White space becomes
    a space, marks that are drawn over another character are removed, and every other character that is not
    printable (escape codes, changes of the writing direction, lone surrogates) becomes U+FFFD.  Text that is cut
    ends in ``...``.
    """
    short = text if len(text) <= longest else text[: longest - 3] + "..."
    if short.isascii() and short.isprintable():
        return short
    return "".join(map(_printable, short))


def plain_lines(text: str) -> str:
    """Text of several lines, each printable as in ``plain``; the lines are not cut."""
    if text.isascii() and text.replace("\n", "").isprintable():
        return text
    return "\n".join(plain(line, len(line)) for line in text.split("\n"))


def _printable(character: str) -> str:
    if character.isspace():
        return " "
    if not character.isprintable():
        return "\ufffd"
    return "" if unicodedata.category(character) in ("Mn", "Me") else character


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
