"""One check of the doctor, and the table of all checks."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass


@dataclass(frozen=True)
class Check:
    """The result of one check."""

    name: str
    ok: bool | None
    """False: a run would fail.  None is a warning: a run starts, but may be slow or end early."""
    value: str
    remedy: str = ""
    """What to do; empty if the check passed."""


def table(checks: Sequence[Check]) -> str:
    """The checks as text, one line each, the remedy after an arrow."""
    mark = {True: "ok  ", None: "warn", False: "FAIL"}
    width = max((len(check.name) for check in checks), default=0)
    lines = [
        f"{mark[check.ok]}  {check.name:<{width}}  {check.value}" + (f"  -> {check.remedy}" if check.remedy else "")
        for check in checks
    ]
    return "\n".join(line.replace("\n", " ") for line in lines)
