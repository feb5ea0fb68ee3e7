"""A finding of the doctor, and the table of them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass


@dataclass(frozen=True)
class Finding:
    """The answer to one question."""

    name: str
    ok: bool | None
    """None is a warning: a run starts, but something may go short."""
    value: str
    remedy: str = ""
    """What to do; empty where there is nothing to do."""


def table(findings: Sequence[Finding]) -> str:
    """The findings for people, one line each, the remedy behind an arrow."""
    mark = {True: "ok  ", None: "warn", False: "FAIL"}
    width = max((len(f.name) for f in findings), default=0)
    lines = [f"{mark[f.ok]}  {f.name:<{width}}  {f.value}" + (f"  -> {f.remedy}" if f.remedy else "") for f in findings]
    return "\n".join(line.replace("\n", " ") for line in lines)
