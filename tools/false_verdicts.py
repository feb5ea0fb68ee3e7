"""How often a comparison of equal methods is called higher or lower, by the number of trainings.

Usage, from the repository's root: ``PYTHONPATH=. python tools/false_verdicts.py``.

Two methods without a difference: each training has its own level (standard deviation 1), each task its own (1), and each
evaluation noise (``--noise``), with 20 tasks and 5 evaluations of each.  The nominal rate is 5%.  The last columns are the
rate of the former percentile interval of the mean, and how often the interval of one method's mean holds the true mean.
``--own-tasks``: each training has tasks of its own.  docs/decisions/085-results-are-rows.md holds the numbers.
"""

from __future__ import annotations

import argparse

import numpy as np

from icrl_dist.results import comparison, statistics
from icrl_dist.results.names import AgentKey
from icrl_dist.results.returns import Returns

TASKS, EVALUATIONS = 20, 5


def method(rng: np.random.Generator, trainings: int, tasks: np.ndarray, noise: float, own: bool) -> Returns:
    """Returns of one method; its true mean is 5."""
    levels = 5 + rng.normal(size=(trainings, 1, 1)) + tasks
    returns = levels + noise * rng.normal(size=(trainings, TASKS, EVALUATIONS))
    cells = tuple(
        tuple((training if own else 0, task, (("null", "{}"),) * EVALUATIONS) for task in range(TASKS))
        for training in range(trainings)
    )
    return Returns(
        AgentKey("t0"),
        "t0",
        0.0,
        returns[..., None],
        None,
        False,
        0,
        tuple(range(trainings)),
        cells,
        tuple(range(EVALUATIONS)),
        {},
        np.full((*returns.shape, 1), np.nan),
    )


def main() -> None:
    """Print the rates, a line for each number of trainings."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--trainings", type=int, nargs="+", default=[2, 3, 5, 8, 10])
    parser.add_argument("--runs", type=int, default=300, help="comparisons for each number of trainings")
    parser.add_argument("--resamples", type=int, default=150)
    parser.add_argument("--noise", type=float, default=1.0)
    parser.add_argument("--own-tasks", action="store_true")
    chosen = parser.parse_args()
    statistics.RESAMPLES = chosen.resamples
    print("trainings  mean  IQM  minimum  ratio  improvement  percentile  coverage")
    for trainings in chosen.trainings:
        rng, found = np.random.default_rng(trainings), []
        for _ in range(chosen.runs):
            tasks = rng.normal(size=(trainings if chosen.own_tasks else 1, TASKS, 1))
            pair = [method(rng, trainings, tasks, chosen.noise, chosen.own_tasks) for _ in range(2)]
            verdicts = [row.verdict != "not shown" for row in comparison.compare(pair[0], pair[1])]
            scores = np.stack([one.scores() for one in pair])
            drawn = statistics.bootstrap(scores, statistics.mean, rng, chosen.resamples, pair[0].crossed)
            low, high = np.percentile(drawn[:, 1] - drawn[:, 0], (2.5, 97.5))
            (one,) = statistics.estimate(scores[:1], statistics.mean, pair[0].crossed)
            found.append([*verdicts, not low <= 0 <= high, one.low <= 5 <= one.high])
        print(f"{trainings:9d}", *(f"{rate:6.1%}" for rate in np.mean(found, axis=0)), flush=True)


if __name__ == "__main__":
    main()
