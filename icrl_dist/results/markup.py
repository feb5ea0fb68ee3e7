"""Tables as Markdown, HTML and JSON values."""

from __future__ import annotations

import html
import math
from dataclasses import dataclass
from typing import Any

from icrl_dist.results.statistics import Interval

CERTIFIED = (
    "Certified: mean exact return of the last episodes, each given its context, against the worst adversary that overrides "
    "actions with probability p; wind and permuted controls are not in it, nor an adversary that also acts while the context "
    "is collected; - where it is not known, as where the context grows within an episode"
)
"""Caption of the column ``certified``."""


@dataclass(frozen=True)
class Sheet:
    """A table of texts."""

    title: str
    columns: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]
    caption: str = ""

    def markdown(self) -> str:
        """The table as Markdown, with its title in bold and its caption below."""
        lines = [f"**{self.title}**", "", _line(self.columns), "|---" * len(self.columns) + "|", *map(_line, self.rows)]
        return "\n".join([*lines, *(["", self.caption] if self.caption else [])]) + "\n"

    def html(self) -> str:
        """The table as HTML."""
        head = "".join(f"<th>{html.escape(name)}</th>" for name in self.columns)
        body = "\n".join("<tr>" + "".join(f"<td>{html.escape(cell)}</td>" for cell in row) + "</tr>" for row in self.rows)
        title, caption = html.escape(self.title), html.escape(self.caption).replace("\n\n", "<br>")
        return f"<h3>{title}</h3>\n<table>\n<tr>{head}</tr>\n{body}\n</table>\n<p class='caption'>{caption}</p>"

    def data(self) -> dict[str, Any]:
        """The table as JSON values."""
        rows = [dict(zip(self.columns, row, strict=True)) for row in self.rows]
        return {"title": self.title, "columns": list(self.columns), "rows": rows, "caption": self.caption}


def _line(cells: tuple[str, ...]) -> str:
    return "| " + " | ".join(cell.replace("|", "\\|").replace("\n", " ") for cell in cells) + " |"


def number(value: float, form: str = "{:.2f}") -> str:
    """A number; ``-`` if it is not known."""
    return "-" if math.isnan(value) else form.format(value)


def interval(of: Interval, form: str = "{:+.2f}") -> str:
    """A number with its interval, such as ``+0.40 [-0.30, +1.33]``."""
    if math.isnan(of.value) or math.isnan(of.low):
        return number(of.value, form)
    return f"{form.format(of.value)} [{form.format(of.low)}, {form.format(of.high)}]"
