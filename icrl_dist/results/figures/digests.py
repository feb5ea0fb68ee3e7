"""The table of digests: what each training of a setting ended with, so that a repetition can be compared."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from icrl_dist.results.claims import costs
from icrl_dist.results.figures.budgets import newest
from icrl_dist.results.figures.selection import METHODS, MissingError, Study
from icrl_dist.results.markup import Sheet

TITLE = "Digests"
_SHOWN = 16
"""Digits of a digest that the table shows, as messages of a run do."""
_STAGES = ("collect", "fit", "evaluate")


def sheet(study: Study) -> Sheet:
    """One row for each training: digests of its newest model and of its dataset, and its CPU-seconds.

    The dataset and the CPU-seconds come from the ``runs.json`` beside the rows; "-" without one.
    """
    arms = newest(study)
    if not arms:
        raise MissingError("figure digests", [study.run(method) for method in METHODS])
    known = costs.ledger(study.rows.files)
    rows = []
    for arm in arms:
        for part in arm.parts:
            entry = known.get((study.setting, arm.key.variant, part.training_seed), {})
            digests = [str(entry.get("dataset_digest") or ""), part.weights_digest]
            seed, split = str(part.training_seed), "-" if part.split_seed is None else str(part.split_seed)
            rows.append((arm.key.variant, seed, split, *(text[:_SHOWN] or "-" for text in digests), *_seconds(entry)))
    caption = (
        f"One row for each training; the first {_SHOWN} digits of each digest, the weights of its newest model. CPU-seconds "
        "are measured, and depend on the machine and its load; a repetition has the same digests"
    )
    title = TITLE + (f", setting {study.setting}" if study.setting else "")
    columns = ("variant", "seed", "split seed", "dataset", "weights", *(f"CPU-s, {stage}" for stage in _STAGES))
    return Sheet(title, columns, tuple(rows), caption)


def _seconds(entry: Mapping[str, Any]) -> tuple[str, ...]:
    """CPU-seconds by stage, "-" where they are not known."""
    found = entry.get("cpu_seconds")
    found = found if isinstance(found, Mapping) else {}
    return tuple(f"{found[stage]:.0f}" if stage in found else "-" for stage in _STAGES)
