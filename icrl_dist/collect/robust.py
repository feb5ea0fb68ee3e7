"""Jobs of robust policies: their training, and histories of SAC experts that they label (section 3.2)."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Sequence

import numpy as np

from icrl_dist.collect.trajectories import unlabelled
from icrl_dist.config.sac import SACConfig
from icrl_dist.experts import cache
from icrl_dist.experts.adversarial import policies
from icrl_dist.experts.adversarial.payloads import Game, RobustlyLabelledHistories, RobustPolicies
from icrl_dist.experts.adversarial.policies import Bounds, Robust
from icrl_dist.experts.cache import History
from icrl_dist.experts.train import histories
from icrl_dist.experts.trajectories import evenly_spaced, history_trajectories
from icrl_dist.interfaces import Problem, Progress
from icrl_dist.types import Job, Task, Trajectory, Variation


def train_robust(job: Job, problem: Problem, worker: str, progress: Progress) -> Iterator[Trajectory]:
    """Undisturbed episodes of the robust policy of each task, which is trained and cached if it is missing."""
    payload = job.payload
    assert isinstance(payload, RobustPolicies)
    found = _policies(job, problem, payload.sac, payload.game, progress)
    for row, one in zip(range(len(job.variations)), found, strict=True):
        for identity, episode in evenly_spaced(job, row, len(one.window_rewards)):
            rewards = one.window_rewards[episode]
            yield Trajectory(
                identity=identity,
                variation=job.variation(identity),
                policy_version=job.policy_version,
                weights_digest="",
                worker=worker,
                observations=one.window_observations[episode],
                actions=one.window_actions[episode],
                rewards=rewards,
                adversary=np.zeros((len(rewards), problem.limits.disturbances or 1), np.float32),
                **unlabelled(problem.spec_of(job.variations[0].task))._asdict(),
            )


def robust_labels(job: Job, problem: Problem, worker: str, progress: Progress) -> Iterator[Trajectory]:
    """DPT's histories of SAC experts, in which the robust policy of each task labels and acts in action windows."""
    payload = job.payload
    assert isinstance(payload, RobustlyLabelledHistories)
    found = histories(job, problem, payload.sac, progress)
    robust = _policies(job, problem, payload.sac, payload.game, progress)
    labelled = [_labelled(history, one, payload.sac, payload.game) for history, one in zip(found, robust, strict=True)]
    act = policies.act_of(robust, payload.sac, payload.game)
    yield from history_trajectories(job, problem, payload.labelling, labelled, worker, act)


def _labelled(history: History, robust: Robust, sac: SACConfig, game: Game) -> History:
    states = history.observations[:, :-1]
    labels = policies.act_of([robust], sac, game)(states.reshape(1, -1, states.shape[-1])).reshape(history.labels.shape)
    names = ("window_actions", "window_observations", "window_rewards", "window_labels")
    return dataclasses.replace(history, labels=labels, actor=robust.actor, **{name: getattr(robust, name) for name in names})


def _policies(job: Job, problem: Problem, sac: SACConfig, game: Game, progress: Progress) -> list[Robust]:
    tasks = [variation.task for variation in job.variations]
    return policies.robust_policies(tasks, problem, sac, game, job.seed, _bounds(job, problem, sac, game, progress), progress)


def _bounds(job: Job, problem: Problem, sac: SACConfig, game: Game, progress: Progress) -> Bounds:
    """QARL's bounds, from the undisturbed SAC experts of the job's tasks, which are trained if they are not in the cache."""

    def bounds(tasks: Sequence[Task]) -> np.ndarray:
        horizon = problem.spec_of(tasks[0]).horizon
        found = {task: cache.load_any(Variation(task), horizon, sac, job.seed) for task in tasks}
        if None in found.values():
            made = histories(dataclasses.replace(job, trials=1), problem, sac, progress)
            found = {variation.task: history for variation, history in zip(job.variations, made, strict=True)}
        experts = [history.window_rewards for task in tasks if (history := found[task]) is not None]
        return policies.expert_bounds(experts, sac.gamma, game.settings.bound)

    return bounds
