"""The claims as tables and as JSON values."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from icrl_dist.results.claims.findings import HELD, MAIN_SEEDS, MARGIN, NOT_DECIDABLE, NOT_HELD, NOT_SHOWN, Finding
from icrl_dist.results.claims.questions import Claim
from icrl_dist.results.figures.panels import plain
from icrl_dist.results.markup import CERTIFIED, Sheet, interval, number
from icrl_dist.results.statistics import Interval, counted

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
            rows.append(("", *_cells(one), str(one.seeds), f"{one.verdict}{'' if one.needed else ', beside'}{mark}"))
    caption = (
        "Effects are differences of mean returns in pairs, with 95% intervals over training seeds, which are drawn with "
        "all their tasks where these are their own. The verdict is that of the last episodes: held, if the interval lies "
        "on the claimed side of 0; not held, if on the other; not shown, if it contains 0. Where a margin is named it "
        f"takes the place of 0: {MARGIN:.0%} of the oracle's return at that p. A claim held only if each of its comparisons "
        "did, and did not hold if any did not; those marked `beside` are shown with it and decide nothing. Intervals are "
        f"not corrected for the number of comparisons ({count} here): where all true differences are 0, each interval lies "
        "on the wrong side with probability 2.5%, so the more comparisons a claim has, the more likely it is `not held` by "
        "chance. "
        f"{CERTIFIED}; here the same sum of them{_few([one for claim in claims for one in claim.findings])}"
    )
    columns = ("claim", "comparison", "effect, last episodes", "effect, all episodes", "certified", "seeds", "verdict")
    return Sheet(
        "The claims one by one", columns, tuple(rows), caption + "".join(f"\n\n[{n}] {note}" for note, n in notes.items())
    )


def _few(findings: Sequence[Finding]) -> str:
    """What the caption adds about comparisons of fewer training seeds than are wanted, and of trainings with one split."""
    text = ""
    few = [one for one in findings if one.seeds and one.main and one.seeds < MAIN_SEEDS]
    if few:
        text += (
            f". Note: {counted(len(few), 'comparison')} of DPT, ICAG and ICAA with each other "
            f"{'has' if len(few) == 1 else 'have'} fewer than the {MAIN_SEEDS} training seeds that are wanted (column seeds)"
        )
    if shared := [one for one in findings if one.shared_splits]:
        text += (
            f". Warning: in {counted(len(shared), 'comparison')} trainings share a split of the tasks, so the intervals say "
            'too little about other splits; give each training its own (split_seed = "seed" in the sweep file)'
        )
    return text


def _cells(one: Finding) -> tuple[str, ...]:
    name = one.comparison + (f", margin {one.margin:.2f}" if one.margin else "")
    return name, interval(one.effect, one.form), interval(one.overall, one.form), number(one.certified, one.form)


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
                    "margin": one.margin,
                    "needed": one.needed,
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
