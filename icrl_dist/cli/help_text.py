"""Help of commands from docstrings: paragraphs that are wrapped to the terminal, whatever their line breaks in the source."""

from __future__ import annotations

import inspect
import re
import shutil
import textwrap
from typing import Any

import tyro
from tyro import _strings

_SPACE = "\0"
"""Stands for a space at which no line is broken."""


class _Wrapped(str):
    """A text whose line breaks are meant."""


def cli(kind: type, **options: Any) -> Any:
    """``tyro.cli(kind, **options)`` with such help.

    tyro keeps a line break of a docstring where the next line is indented or begins with no letter, so that help has short
    lines in the middle of sentences; and it does not wrap a command's description.
    """
    width = min(100, shutil.get_terminal_size().columns)
    paragraphs = _joined(inspect.cleandoc(kind.__doc__ or "")).split("\n\n")
    description = _Wrapped("\n\n".join(filled(one, width) for one in paragraphs))
    original = _strings.remove_single_line_breaks
    _strings.remove_single_line_breaks = _unless_wrapped
    try:
        return tyro.cli(kind, description=description, **options)
    finally:
        _strings.remove_single_line_breaks = original


def _unless_wrapped(helptext: str) -> str:
    return helptext if isinstance(helptext, _Wrapped) else _joined(helptext)


def filled(text: str, width: int, indent: str = "") -> str:
    """The text in lines of ``width``; an example between double backticks is not broken."""
    whole = re.sub("``.*?``", lambda found: found[0].replace(" ", _SPACE), text)
    options = {"break_long_words": False, "break_on_hyphens": False}
    return textwrap.fill(whole, width, subsequent_indent=indent, **options).replace(_SPACE, " ")  # type: ignore[arg-type]


def _joined(text: str) -> str:
    """The text with one line for each paragraph."""
    return "\n\n".join(" ".join(part.split()) for part in text.split("\n\n"))
