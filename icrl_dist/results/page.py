"""A report as one HTML page without files beside it: pictures are in the page, and nothing is loaded from a network."""

from __future__ import annotations

import base64
import html as escaping
from collections.abc import Sequence
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from icrl_dist.results.paper_report import Section

_STYLE = """
body { font: 15px/1.5 system-ui, sans-serif; color: #24292f; max-width: 1100px; margin: 2em auto; padding: 0 1em; }
table { border-collapse: collapse; font-size: 13px; font-variant-numeric: tabular-nums; display: block; overflow-x: auto; }
th, td { padding: 3px 10px; text-align: right; border-bottom: 1px solid #d0d7de; white-space: nowrap; }
th:first-child, td:first-child { text-align: left; }
img { max-width: 100%; }
.caption { color: #57606a; font-size: 13px; }
nav a { margin-right: 1.2em; }
"""


def html(sections: Sequence[Section], refused: Sequence[str]) -> str:
    """The page, in HTML."""
    links = " ".join(f"<a href='#s{i}'>{escaping.escape(one.title)}</a>" for i, one in enumerate(sections))
    body = "\n".join(_section(one, f"s{i}") for i, one in enumerate(sections))
    lines = "".join(f"<li>{escaping.escape(line)}</li>" for line in dict.fromkeys(refused))
    left_out = f"<h2>Left out</h2><ul class='caption'>{lines}</ul>" if lines else ""
    return (
        "<!doctype html>\n<html lang='en'><head><meta charset='utf-8'><meta name='viewport' content='width=device-width'>"
        f"<title>icrl-dist report</title><style>{_STYLE}</style></head>\n"
        f"<body><h1>icrl-dist report</h1><nav>{links}</nav>\n{body}\n{left_out}</body></html>\n"
    )


def _section(section: Section, anchor: str) -> str:
    title = escaping.escape(section.title)
    text = "".join(f"<p>{escaping.escape(part)}</p>" for part in section.text.split("\n\n") if part)
    picture = ""
    if section.picture:
        content = base64.b64encode(section.picture.read_bytes()).decode()
        picture = f"<img alt='{title}' src='data:image/png;base64,{content}'>"
    return (
        f"<section id='{anchor}'><h2>{title}</h2>{text}{picture}{''.join(sheet.html() for sheet in section.sheets)}</section>"
    )
