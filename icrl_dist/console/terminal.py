"""The console that every command prints to: text is plain, because much of it comes from other processes and files."""

from __future__ import annotations

from typing import Any

from rich.console import Console
from rich.text import Text

from icrl_dist.stream.excerpts import plain_lines


class PlainConsole(Console):
    """A console on which text is never markup, and holds no character that a terminal would execute."""

    def __init__(self, **options: Any) -> None:
        super().__init__(markup=False, emoji=False, **options)

    def render_str(self, text: str, **options: Any) -> Text:
        return super().render_str(plain_lines(text), **options)
