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
from icrl_dist.results.figures.selection import Study
from icrl_dist.storage.files import StoreError

Ledger = Mapping[tuple[str, str, int], Mapping[str, Any]]
"""Costs of a training by setting, variant and training seed."""
COSTS = {"environment_steps": "environment steps", "cpu_seconds": "CPU-seconds", "label_bytes": "bytes of labels"}


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
    """What ICAG costs more than ICAA, in each kind of cost, paired over training seeds."""
    variants = {name: study.variant(name) for name in ("icag", "icaa")}
    arms = {name: study.model(variant, study.levels(variant)[0]) for name, variant in variants.items() if variant}
    for column, text in COSTS.items():
        if column == "label_bytes" and not any(column in run for run in known.values()):
            continue  # a sweep that does not measure them
        comparison = f"ICAG - ICAA, {text}"
        values = {name: cost(arm, column, known) for name, arm in arms.items() if arm is not None}
        seeds = sorted(set.intersection(*map(set, values.values()))) if len(values) == 2 else []
        if not seeds:
            missing = "; ".join(study.run(variants[name] or name) for name in variants if not values.get(name))
            reason = f"{text} are not known of both; these runs make them: {missing or 'those of the sweep, with runs.json'}"
            yield Finding(comparison, UNKNOWN, UNKNOWN, math.nan, 0, NOT_DECIDABLE, reason)
            continue
        scores = np.array([[[[values[name][seed]]] for seed in seeds] for name in ("icag", "icaa")], float)
        (effect,) = statistics.estimate(scores, lambda of: statistics.mean(of[:, :1] - of[:, 1:]))
        yield Finding(
            comparison, effect, UNKNOWN, math.nan, len(seeds), verdict(effect, 1, len(seeds)), few(len(seeds)), "{:+,.0f}"
        )


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
