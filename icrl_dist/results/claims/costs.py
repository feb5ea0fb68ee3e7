"""What the trainings of ICAG and ICAA cost, from the budgets in the rows and from the ``runs.json`` of a sweep."""

from __future__ import annotations

import json
import math
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from icrl_dist.results import statistics
from icrl_dist.results.claims.findings import NOT_DECIDABLE, UNKNOWN, Finding, few, verdict
from icrl_dist.results.figures.reading import Arm
from icrl_dist.results.figures.selection import Study, listed
from icrl_dist.results.markup import Sheet
from icrl_dist.storage.files import StoreError

Ledger = Mapping[tuple[str, str, int], Mapping[str, Any]]
"""Costs of a training by setting, variant and training seed."""
LABELS = "labels"
COSTS = {
    "environment_steps": ("environment steps per label", 1),
    "cpu_seconds": ("CPU-seconds of training per 1000 labels", 1000),
    "label_bytes": ("bytes of states and labels per label", 1),
    "sent_bytes": ("bytes sent to the learner per label", 1),
}
"""Columns of costs, what each is divided by the labels, and of how many labels: totals are equal by design in a comparison
with equal budgets, so they say nothing."""


def ledger(files: Sequence[Path]) -> Ledger:
    """The entries of the ``runs.json`` beside each file of rows; empty without one.

    Raises StoreError for a file that holds no list of runs.
    """
    found: dict[tuple[str, str, int], Mapping[str, Any]] = {}
    for path in dict.fromkeys(file.parent / "runs.json" for file in files):
        if not path.is_file():
            continue
        try:
            content = json.loads(path.read_text())
            runs = content["runs"] if isinstance(content, dict) else content
            runs = list(runs.values()) if isinstance(runs, dict) else runs
            found |= {(str(run["setting"]), str(run["variant"]), int(run["seed"])): run for run in runs}
        except (OSError, ValueError, KeyError, TypeError) as error:
            reason = f"{type(error).__name__}: {error}"
            raise StoreError(
                f"{path}: no list of a sweep's runs ({reason}): repeat `icrl-dist sweep`, or move it away"
            ) from None
    return found


def findings(study: Study, known: Ledger) -> Iterator[Finding]:
    """What a label of ICAG costs more than one of ICAA, in each kind of cost, paired over training seeds."""
    variants = {name: study.variant(name) for name in ("icag", "icaa")}
    arms = {name: study.model(variant, study.levels(variant)[0]) for name, variant in variants.items() if variant}
    for column, (text, of) in COSTS.items():
        comparison = f"ICAG - ICAA, {text}"
        values = {name: per_label(arm, column, known, of) for name, arm in arms.items() if arm is not None}
        seeds = sorted(set.intersection(*map(set, values.values()))) if len(values) == 2 else []
        if not seeds:
            missing = "; ".join(study.run(variants[name] or name) for name in variants if not values.get(name))
            what = f"{missing or 'those of equal seeds'}, with the runs.json of their sweep beside the rows"
            reason = f"{text} are not known of both; these runs make them: {what}"
            yield Finding(comparison, UNKNOWN, UNKNOWN, math.nan, 0, NOT_DECIDABLE, reason)
            continue
        scores = np.array([[[[values[name][seed]]] for seed in seeds] for name in ("icag", "icaa")], float)
        (effect,) = statistics.estimate(scores, lambda of: statistics.mean(of[:, :1] - of[:, 1:]))
        yield Finding(
            comparison,
            effect,
            UNKNOWN,
            math.nan,
            len(seeds),
            verdict(effect, 1, len(seeds)),
            few(len(seeds)),
            "{:+,.3g}",
            main=True,
        )


def per_label(arm: Arm, column: str, known: Ledger, of: int = 1) -> dict[int, float]:
    """One cost of so many labels by training seed, of those of which cost and labels are known."""
    labels = cost(arm, LABELS, known)
    return {seed: of * value / labels[seed] for seed, value in cost(arm, column, known).items() if labels.get(seed)}


def sheet(study: Study, known: Ledger) -> Sheet:
    """What a training of ICAG and of ICAA cost, in total and for each label; means over training seeds."""
    rows = []
    for name in ("icag", "icaa"):
        variant = study.variant(name)
        arm = study.model(variant, study.levels(variant)[0]) if variant and study.levels(variant) else None
        if variant is None or arm is None:
            continue
        totals = [cost(arm, column, known) for column in (LABELS, *COSTS)]
        shares = [per_label(arm, column, known, of) for column, (_, of) in COSTS.items()]
        cells = [
            _mean(found, form) for found, form in [*((one, "{:,.0f}") for one in totals), *((s, "{:,.3g}") for s in shares)]
        ]
        rows.append((variant, listed(arm.seeds), *cells))
    columns = (LABELS, *(name.replace("_", " ") for name in COSTS), *(text for text, _ in COSTS.values()))
    caption = (
        "One training, mean over training seeds. Labels: labelled states whose labels the fits use, of ICAA also every step of "
        "the trials that it takes as labels. Labels and bytes are computed from the run file (arrays, without names and "
        "headers), and not counted in a dataset; CPU-seconds are measured, of collecting and fitting, and depend on the "
        "machine and its load. Environment steps are equal by design where budgets are"
    )
    title = "Costs of ICAG and ICAA" + (f", setting {study.setting}" if study.setting else "")
    return Sheet(title, ("variant", "seeds", *columns), tuple(rows), caption)


def _mean(found: Mapping[int, float], form: str) -> str:
    return form.format(float(np.mean(list(found.values())))) if found else "-"


def cost(arm: Arm, column: str, known: Ledger) -> dict[int, float]:
    """One cost by training seed, of those of which it is known: from the rows, or else from the ledger."""
    found = {}
    for part in arm.parts:
        entry = known.get((arm.key.setting, arm.key.variant, part.training_seed), {})
        value = getattr(part, column, None)
        value = entry.get(column) if value is None else value
        if isinstance(value, Mapping):  # CPU-seconds by stage: what training took
            value = sum(seconds for stage, seconds in value.items() if stage != "evaluate")
        if value is not None:
            found[part.training_seed] = float(value)
    return found
