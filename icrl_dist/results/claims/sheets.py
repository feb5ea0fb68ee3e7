"""The claims as tables and as JSON values."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from icrl_dist.results.claims.findings import HELD, NOT_DECIDABLE, NOT_HELD, NOT_SHOWN, Finding
from icrl_dist.results.claims.questions import Claim
from icrl_dist.results.figures.panels import plain
from icrl_dist.results.markup import CERTIFIED, Sheet, interval, number
from icrl_dist.results.statistics import Interval

_ORDER = (NOT_HELD, NOT_SHOWN, NOT_DECIDABLE, HELD)


def summary(claims: Sequence[Claim]) -> str:
    """The claims by verdict in one paragraph, those that did not hold first."""
    settings = list(dict.fromkeys(claim.setting for claim in claims))
    lines = []
    for setting in settings:
        here = [claim for claim in claims if claim.setting == setting]
        parts = []
        for verdict in _ORDER:
            texts = [f"({claim.number}) {claim.text}" for claim in here if claim.verdict == verdict]
            parts += [f"{verdict[0].upper()}{verdict[1:]}: {'; '.join(texts)}."] if texts else []
        lines.append((f"Setting {setting}. " if setting else "") + " ".join(parts))
    return "\n\n".join(lines)


def sheet(claims: Sequence[Claim]) -> Sheet:
    """One row for each comparison; the caption says what decides and, by number, what those that are not decidable lack."""
    notes: dict[str, int] = {}
    count = sum(len(claim.findings) for claim in claims)
    rows: list[tuple[str, ...]] = []
    for claim in claims:
        name = f"{claim.number}. {claim.text}" + (f" ({claim.setting})" if claim.setting else "")
        rows.append((name, "", "", "", "", "", claim.verdict))
        for one in claim.findings:
            mark = f" [{notes.setdefault(one.reason, len(notes) + 1)}]" if one.reason else ""
            rows.append(("", *_cells(one), str(one.seeds), f"{one.verdict}{mark}"))
    caption = (
        "Effects are differences of mean returns in pairs, with 95% intervals over training seeds, which are drawn with all "
        "their tasks where these are their own. The verdict is that of the last episodes: held, if the interval lies on the "
        "claimed side of 0; not held, if on the other; not shown, if it contains 0. A claim held only if each of its "
        f"comparisons did, and did not hold if any did not. Intervals are not corrected for the number of "
        f"comparisons ({count} here): where all true differences are 0, each interval lies on the wrong side with "
        f"probability 2.5%, so the more comparisons a claim has, the more likely it is `not held` by "
        f"chance. {CERTIFIED}; here the same sum of them"
    )
    columns = ("claim", "comparison", "effect, last episodes", "effect, all episodes", "certified", "seeds", "verdict")
    return Sheet(
        "The claims one by one", columns, tuple(rows), caption + "".join(f"\n\n[{n}] {note}" for note, n in notes.items())
    )


def _cells(one: Finding) -> tuple[str, ...]:
    return one.comparison, interval(one.effect, one.form), interval(one.overall, one.form), number(one.certified, one.form)


def data(claims: Sequence[Claim]) -> list[dict[str, Any]]:
    """The claims as JSON values; None for unknown numbers."""
    return [
        {
            "number": claim.number,
            "text": claim.text,
            "setting": claim.setting,
            "verdict": claim.verdict,
            "findings": [
                {
                    "comparison": one.comparison,
                    "effect": _numbers(one.effect),
                    "all_episodes": _numbers(one.overall),
                    "certified": plain(one.certified),
                    "seeds": one.seeds,
                    "verdict": one.verdict,
                    "reason": one.reason,
                }
                for one in claim.findings
            ],
        }
        for claim in claims
    ]


def _numbers(of: Interval) -> dict[str, float | None]:
    return {name: plain(value) for name, value in of._asdict().items()}
