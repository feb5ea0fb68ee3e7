"""Write tests/results/rliable.json: statistics of small random scores as the library rliable computes them.

The tests of ``icrl_dist.results.statistics`` compare with this file, so they need no rliable.  rliable is installed
in an environment of its own.  Usage, from the repository's root::

    python -m venv /tmp/rliable && /tmp/rliable/bin/pip install rliable
    /tmp/rliable/bin/python tools/rliable_golden.py > tests/results/rliable.json
"""

from __future__ import annotations

import json
from importlib import metadata

import numpy as np
from rliable import metrics

SHAPES = ((1, 1), (1, 20), (2, 3), (3, 20), (5, 4), (10, 7))
"""Trainings and tasks of each case."""


def case(seed: int, trainings: int, tasks: int) -> dict[str, object]:
    """Scores of two algorithms, and rliable's numbers.  Every second case has rounded scores, so it has ties."""
    rng = np.random.default_rng(seed)
    x, y = rng.normal(0.6, 0.2, size=(trainings, tasks)), rng.normal(0.5, 0.3, size=(trainings + seed % 3, tasks))
    if seed % 2:
        x, y = x.round(1), y.round(1)
    return {
        "x": x.tolist(),
        "y": y.tolist(),
        "mean": float(metrics.aggregate_mean(x)),
        "iqm": float(metrics.aggregate_iqm(x)),
        "probability_of_improvement": float(metrics.probability_of_improvement(x, y)),
    }


if __name__ == "__main__":
    cases = [case(seed, *shape) for seed, shape in enumerate((*SHAPES, *SHAPES))]
    print(json.dumps({"rliable": metadata.version("rliable"), "scipy": metadata.version("scipy"), "cases": cases}, indent=1))
