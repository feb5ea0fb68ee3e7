"""The table of ICAA's own labels by round, from the rows of suite ``label_quality`` that its training wrote."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float64

from icrl_dist.results import statistics
from icrl_dist.results.figures.reading import batches
from icrl_dist.results.figures.selection import MissingError, Study, listed
from icrl_dist.results.markup import Sheet, interval
from icrl_dist.results.statistics import Interval
from icrl_dist.results.summaries import label_quality

_PLACE = ("setting", "variant", "training_seed", "policy_version")
_COLUMNS = (*_PLACE, "task_index", "adversary_index", "data", "return", "agreement", "optimum")


class Round(NamedTuple):
    """One round of one training."""

    variant: str
    seed: int
    version: int
    """Version of the policy that acted: round j is T^j's."""


def sheet(study: Study) -> Sheet:
    """One row for each round: agreement with the optimum, and returns of context and of labelled trials.

    Raises MissingError without rows, StoreError for a file that is damaged.
    """
    variant = study.variant("icaa") or "icaa"
    found = dict(_rounds(study.rows.files, study.setting, variant))
    if not found:
        raise MissingError("table of ICAA's labels", [study.run(variant)])
    lines = []
    for version in sorted({one.version for one in found}):
        seeds = sorted(one.seed for one in found if one.version == version)
        values = np.array([found[Round(variant, seed, version)] for seed in seeds])
        lines.append((f"{version}", f"T^{version}", listed(seeds), *_cells(values)))
    title = "ICAA: the labels of each round" + (f", setting {study.setting}" if study.setting else "")
    caption = (
        "In round j T^j acts in the training variations: its first trials become contexts, and labels come from its own "
        "trials, as icaa.labels says. Agreement: share of the labels that are optimal in their variation, mean over the "
        "variations that gave labels; labelling: share of the variations that gave labels. Returns: mean over all "
        "variations, of the trials that became contexts and of the later ones. 95% intervals over training seeds; each seed "
        "is one number, and the gain is in pairs"
    )
    columns = ("round", "policy", "seeds", "agreement", "labelling", "return, contexts", "return, later trials", "gain")
    return Sheet(title, columns, tuple(lines), caption)


def _cells(values: Float64[np.ndarray, "S 4"]) -> Iterator[str]:
    """The four numbers of one round and the gain of later trials over contexts, with intervals over trainings."""
    numbers = [*values.T, values[:, 3] - values[:, 2]]
    for number, form in zip(numbers, ("{:.1%}", "{:.1%}", "{:.2f}", "{:.2f}", "{:+.2f}"), strict=True):
        yield interval(_over_seeds(number), form)


def _over_seeds(values: Float64[np.ndarray, " S"]) -> Interval:
    (found,) = statistics.estimate(values.reshape(1, -1, 1, 1), statistics.mean)
    return found


def _rounds(files: Sequence[Path], setting: str, variant: str) -> Iterator[tuple[Round, tuple[float, ...]]]:
    """Agreement, labelling, and returns of contexts and of later trials, of every round; one file is in memory at a time."""
    import pandas as pd

    for path in files:
        parts = [batch.to_pandas() for batch in batches(path, _COLUMNS, ("label_quality",))]
        here = [part[(part["setting"] == setting) & (part["variant"] == variant)] for part in parts]
        if not any(map(len, here)):
            continue
        for (seed, version), one in pd.concat(here).groupby(["training_seed", "policy_version"]):
            found = label_quality(one)
            agreement = found.agreement if found.labelling else np.nan
            numbers = (agreement, found.labelling, found.context_return, found.label_return)
            yield Round(variant, int(seed), int(version)), numbers
