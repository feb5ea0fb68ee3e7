"""How unlike pretraining a context is: what a deployed T_theta is told of its own predictions."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence

import numpy as np
from jaxtyping import Float

from icrl_dist.config.run import Run
from icrl_dist.methods.recipes import METHODS
from icrl_dist.models.dpt import PretrainedTransformer
from icrl_dist.models.outcome_readout import WINDOWS, Decisions, OutcomeModel
from icrl_dist.problems import registry, splits
from icrl_dist.rollout import deployment
from icrl_dist.types import Spec, Variation

EPISODES = 5
"""Online episodes in each training variation that outcomes are learned from."""

_CHANCE = 105  # spawn key of these episodes' draws, apart from every other's
_FRESH = 1 << 20  # a round that no run reaches: its adversaries were never trained on


class Surprise:
    """The running surprise of B environments: hand ``observe`` to their policy as its ``watch``."""

    def __init__(self, model: OutcomeModel, spec: Spec, batch: int) -> None:
        self._model, self._spec = model, spec
        self._losses = np.zeros((batch, 0), np.float32)

    def observe(self, *decision: np.ndarray) -> None:
        """One decision of each environment and what came of it: the columns of ``Decisions``."""
        state, before, action, reward, after = decision
        loss = self._model.loss(self._spec, (state, before, action, reward, after))
        self._losses = np.concatenate([self._losses[:, 1 - WINDOWS[-1] :], loss[:, None]], axis=1)

    def now(self) -> Float[np.ndarray, " B"]:
        """See ``OutcomeModel.surprise``; 0 before the first transition."""
        return self._model.surprise(self._losses)


def calibrate(run: Run, model: PretrainedTransformer, progress: Callable[[int], None] = lambda episodes: None) -> OutcomeModel:
    """Deploys T_theta in its training tasks, under adversaries it never met, and fits and calibrates what it expects.

    Fitted to every other task, calibrated on the rest; ``progress`` hears of each of the
    ``2 * EPISODES`` episodes.  The same weights give the same answer.
    """
    done = 0

    def step(rows: Sequence[tuple[int, Variation]]) -> Iterator[Decisions]:
        nonlocal done
        for seen in _decisions(run, model, rows):
            done += 1
            progress(done)
            yield from seen

    rows = list(_rows(run))
    halves = ([row for row in rows if row[0] % 2 == half] for half in (0, 1))
    fitted, heldout = (step(half or rows) for half in halves)
    return OutcomeModel.fit(model.spec, fitted, heldout)


def _rows(run: Run) -> Iterator[tuple[int, Variation]]:
    """Two of the method's variations of every training task, phi_0 as often as it trains on it."""
    for index, task in enumerate(splits.split(run).train):
        chosen = METHODS[run.method].variations(run, index, splits.deployed(task), _FRESH)
        for turn in (0, len(chosen) // 2):
            yield index, chosen[(index // 2 + turn) % len(chosen)]


def _decisions(run: Run, model: PretrainedTransformer, rows: Sequence[tuple[int, Variation]]) -> Iterator[list[Decisions]]:
    """The decisions of every episode, deployed as a user would."""
    seen: list[Decisions] = []
    env = registry.batch([variation for _, variation in rows])
    watch = lambda *decision: seen.append(decision)  # noqa: E731
    policy = deployment.in_context(model, len(rows), run.context, watch=watch)
    keys = [(_CHANCE, index, row) for row, (index, _) in enumerate(rows)]
    for number in range(EPISODES):
        deployment.episode(
            env, policy, [np.random.default_rng(np.random.SeedSequence(run.seed, spawn_key=(*key, number))) for key in keys]
        )
        yield seen
        seen.clear()
