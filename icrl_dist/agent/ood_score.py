"""Out-of-distribution score (``agent.surprise``): how far a context is from pretraining.

A linear readout of the model's states predicts the outcome of each action; the score is its scaled loss.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence

import numpy as np
from jaxtyping import Float

from icrl_dist.agent.trained_model import TrainedModel
from icrl_dist.config.random_keys import RandomKey, generator
from icrl_dist.models.outcome_readout import WINDOWS, Decisions, OutcomeModel
from icrl_dist.problems import registry as problems
from icrl_dist.rollout.episode import episode
from icrl_dist.types import Spec, Variation

EPISODES = 5
"""Online episodes in each training variation that the readout is fitted to or calibrated on."""
_UNUSED_ROUND = 1 << 20
"""A round number that no run reaches, so the model was not trained on its adversaries."""


class Surprise:
    """The running OOD score of B environments; pass ``observe`` to their policy as ``watch``."""

    def __init__(self, model: OutcomeModel, spec: Spec, batch: int) -> None:
        self._model, self._spec = model, spec
        self._losses = np.zeros((batch, 0), np.float32)

    def observe(self, *decision: np.ndarray) -> None:
        """Add one decision of each environment with its outcome: the columns of ``Decisions``."""
        state, before, action, reward, after = decision
        loss = self._model.loss(self._spec, (state, before, action, reward, after))
        self._losses = np.concatenate([self._losses[:, 1 - WINDOWS[-1] :], loss[:, None]], axis=1)

    def score(self) -> Float[np.ndarray, " B"]:
        """The score now (``OutcomeModel.surprise``); 0 before the first transition."""
        return self._model.surprise(self._losses)


def calibrate(trained: TrainedModel, progress: Callable[[int], None] = lambda episodes: None) -> OutcomeModel:
    """Deploy the model in its training tasks under new adversaries; fit and calibrate the outcome readout.

    The readout is fitted to every second task and calibrated on the others.  ``progress`` is called after
    each of the ``2 * EPISODES`` episodes.  The same weights give the same readout.
    """
    done = 0

    def decisions(rows: Sequence[tuple[int, Variation]]) -> Iterator[Decisions]:
        nonlocal done
        for steps in _decisions(trained, rows):
            done += 1
            progress(done)
            yield from steps

    rows = list(_rows(trained))
    halves = ([row for row in rows if row[0] % 2 == half] for half in (0, 1))
    fitted, heldout = (decisions(half or rows) for half in halves)
    return OutcomeModel.fit(trained.spec, fitted, heldout)


def _rows(trained: TrainedModel) -> Iterator[tuple[int, Variation]]:
    """Two of the method's variations of every training task; each has the same share as in training."""
    problem = problems.of(trained.run)
    for index, task in enumerate(problem.split.train):
        chosen = trained.method.training_variations(trained.run, index, problem.at_test_start(task), _UNUSED_ROUND)
        for turn in (0, len(chosen) // 2):
            yield index, chosen[(index // 2 + turn) % len(chosen)]


def _decisions(trained: TrainedModel, rows: Sequence[tuple[int, Variation]]) -> Iterator[list[Decisions]]:
    """The decisions of each episode, by the deployment rule that the model was trained for."""
    steps: list[Decisions] = []
    env = problems.of(trained.run).batch([variation for _, variation in rows])
    watch = lambda *decision: steps.append(decision)  # noqa: E731
    context = trained.run.context
    policy = trained.method.policy(trained.to_deploy(context), len(rows), context, None, watch)
    for number in range(EPISODES):
        keys = [(index, row, number) for row, (index, _) in enumerate(rows)]
        episode(env, policy, [generator(trained.run.seed, RandomKey.OOD_CALIBRATION, *key) for key in keys])
        yield steps
        steps.clear()
