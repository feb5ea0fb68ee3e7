"""The paper's claims as comparisons of mean returns."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from icrl_dist.results.claims import costs
from icrl_dist.results.claims.findings import MARGIN, Finding, Question, Term, answer, difference, together
from icrl_dist.results.figures import figure6
from icrl_dist.results.figures.choices import Choice, Spot
from icrl_dist.results.figures.selection import METHODS, Study, is_inferred

DISTURBED = (0.2, 0.4, 0.6)
"""The strengths p of the paper's comparisons under disturbance."""


@dataclass(frozen=True)
class Claim:
    """One claim of the paper in one setting, with the findings about it."""

    number: int
    text: str
    setting: str
    findings: tuple[Finding, ...]

    @property
    def verdict(self) -> str:
        """``held`` only if each comparison held that the claim needs."""
        return together([one.verdict for one in self.findings if one.needed])


def claims(study: Study, ledger: costs.Ledger) -> list[Claim]:
    """All claims that apply in the setting of a study."""
    found = []
    for number, (text, questions, everywhere) in enumerate(_CLAIMS, 1):
        if everywhere or not is_inferred(study.setting):
            findings = tuple(answer(study, question) for question in questions(study))
            found.append(Claim(number, text, study.setting, findings))
    text = "A label of ICAA is cheaper than one of ICAG"
    return [*found, Claim(len(_CLAIMS) + 1, text, study.setting, tuple(costs.findings(study, ledger)))]


def _method(study: Study, name: str) -> Choice:
    return Choice(name, study.variant(name))


def disturbed(study: Study) -> tuple[float, ...]:
    """The strengths at which claims are read: the paper's, and stronger ones with rows where disturbances are inferred."""
    if not is_inferred(study.setting):
        return DISTURBED
    stronger = {key.p for key in study.keys if key.suite == "online" and key.p > DISTURBED[-1]}
    return (*DISTURBED, *sorted(stronger))


def _spots(study: Study) -> list[Spot]:
    """The disturbed places: the uniform adversary, and unseen priors at 0.2 and wherever there are rows."""
    strengths = disturbed(study)
    unseen = {key.p for key in study.keys if key.prior == "unseen" and key.suite == "online" and key.p in strengths}
    unseen |= set() if is_inferred(study.setting) else {0.2}
    return [Spot(p) for p in strengths] + [Spot(p, "unseen") for p in sorted(unseen)]


def _place(spot: Spot) -> str:
    return f"p = {spot.p:g}" + (f", {spot.prior}" if spot.p else "")


def _lose(study: Study) -> Iterator[Question]:
    needed = ("dpt", "icag", "icaa") if is_inferred(study.setting) else ("dpt", "prompt_dt", "mix_dpt", "icag", "icaa")
    for name in METHODS:
        choice = _method(study, name)
        if name in needed or choice.variant is not None:
            yield Question(f"{choice.label}, p = 0 less p = 0.2", [Term(1.0, choice, Spot(0.0)), Term(-1.0, choice, Spot(0.2))])


def _above(study: Study) -> Iterator[Question]:
    icag, icaa, dpt = (_method(study, name) for name in ("icag", "icaa", "dpt"))
    for spot in _spots(study):
        yield difference(f"ICAG - ICAA, {_place(spot)}", icag, icaa, spot)
        yield difference(f"ICAA - DPT, {_place(spot)}", icaa, dpt, spot)
        yield difference(f"ICAG - DPT, {_place(spot)}", icag, dpt, spot)._replace(needed=False)


def _undisturbed(study: Study) -> Iterator[Question]:
    yield difference("ICAG - DPT, p = 0", _method(study, "icag"), _method(study, "dpt"), Spot(0.0))


def _grows(study: Study) -> Iterator[Question]:
    icag, dpt = _method(study, "icag"), _method(study, "dpt")
    shared = [set(study.levels(choice.variant)) for choice in (icag, dpt) if choice.variant]
    levels = sorted(set.intersection(*shared)) if shared else []
    if len(levels) < 2:
        levels = [0.0, *disturbed(study)]
    weights = np.array(levels) - np.mean(levels)
    weights /= (weights**2).sum()
    pairs = [(Spot(p), float(weight)) for p, weight in zip(levels, weights, strict=True)]
    terms = [Term(sign * w, choice, spot) for sign, choice in ((1, icag), (-1, dpt)) for spot, w in pairs]
    yield Question(
        f"slope of ICAG - DPT over p, {len(levels)} p in {levels[0]:g} to {levels[-1]:g} (return per unit of p)", terms
    )


def _random_contexts(study: Study) -> Iterator[Question]:
    """Section 5.1: given random or expert data, prompt-DT and ARDT struggle, and DPT and ICAG do not."""
    for name in ("prompt_dt", "ardt"):
        for better in ("dpt", "icag"):
            one, other = _method(study, better), _method(study, name)
            spot = Spot(0.0, suite="offline", data="random")
            yield difference(f"{one.label} - {other.label}, random data", one, other, spot)


def _rounds(study: Study) -> Iterator[Question]:
    variant = study.variant("icaa")
    versions = study.versions(variant) if variant else []
    rounds = [Choice("icaa", variant, f"T^{version}", version) for version in (versions if len(versions) > 1 else [0, 1])]
    for spot in [Spot(0.0), *_spots(study)]:
        for before, after in itertools.pairwise(rounds):
            yield difference(f"{after.label} - {before.label}, {_place(spot)}", after, before, spot)
        yield difference(f"ICAG - {rounds[-1].label}, {_place(spot)}", _method(study, "icag"), rounds[-1], spot)


def _enough(study: Study) -> Iterator[Question]:
    """K = 8 suffices if K = 16 is not above it by more than the margin, whatever K = 4 reaches."""
    four, eight, sixteen = (figure6.choice(study, count) for count in figure6.COUNTS)
    for spot in [Spot(0.0), *_spots(study)]:
        margin = Term(MARGIN, Choice("oracle"), spot)
        yield difference(f"K = 16 less K = 8, {_place(spot)}", sixteen, eight, spot, sign=-1)._replace(margin=margin)
        yield difference(f"K = 8 less K = 4, {_place(spot)}", eight, four, spot)._replace(needed=False)


_CLAIMS: Sequence[tuple[str, Callable[[Study], Iterator[Question]], bool]] = (
    ("All methods lose return under p = 0.2", _lose, True),
    ("Under disturbance ICAG is above ICAA, and ICAA above DPT", _above, True),
    ("ICAG is above DPT without disturbance, too", _undisturbed, True),
    ("The advantage of ICAG over DPT grows with p", _grows, True),
    ("DT-based methods (prompt-DT, ARDT) fail on random contexts: DPT and ICAG are above them", _random_contexts, False),
    ("ICAA improves with rounds and stays below ICAG", _rounds, True),
    (f"K = 8 suffices: K = 16 is not above it by more than {MARGIN:.0%} of the oracle's return", _enough, False),
)
"""The claims about returns: text, questions, and whether they apply where the disturbance must be inferred."""
