"""Online rollouts of the in-context policy in each variation (Algorithm 3, line 12; DAgger rounds)."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from icrl_dist.collect.trajectories import trajectory, unlabelled
from icrl_dist.config.ranges import NotNegative, Positive, Share
from icrl_dist.config.sections import ContextConfig, Decoder, Deployment
from icrl_dist.interfaces import Method, Policy, Problem, WeightSource
from icrl_dist.rollout.episode import deploy_online
from icrl_dist.rollout.policies import Exploring
from icrl_dist.types import Identity, Job, LabelCounts, Payload, Trajectory, Variation

Look = Callable[[Policy, int, Identity, Variation], None]
"""Called after every decision with the policy, a row, and the identity and variation of that row.  It must change nothing."""


@dataclass(frozen=True)
class Rollouts(Payload):
    """Histories of T^j without labels; in ICAA the learner makes labels of T^j's later actions."""

    kind: ClassVar[str] = "adapt"
    context_max: Positive
    """Most transitions in a context, as ``context.max``."""
    deploy: Deployment
    """The deployment rule."""
    decoder: Decoder
    """What computes decisions on a CPU, as ``context.decoder``: the run's own, because digests depend on it."""
    explore: Share
    """Probability of a random action, as ``icaa.explore``."""
    explore_from: NotNegative
    """The first trial with random actions."""

    @property
    def labels(self) -> LabelCounts | None:
        return super().labels if isinstance(self, LabelledRollouts) else LabelCounts(0, 0, "none")


@dataclass(frozen=True)
class LabelledRollouts(Rollouts):
    """Histories of T^j that the problem labels: a DAgger round."""

    kind: ClassVar[str] = "adapt_labelled"
    needs: ClassVar[tuple[str, ...]] = ("labeller",)
    labelling: Any
    """The problem's ``Labelling``."""


def rollouts(
    job: Job, problem: Problem, method: Method, weights: WeightSource, worker: str, look: Look | None = None
) -> Iterator[Trajectory]:
    """N + 1 trials in each variation, all by T^j of the version that the job names.

    Raises RuntimeError if a simulation diverges.
    """
    payload = job.payload
    assert isinstance(payload, Rollouts)
    model, weights_digest = weights.at(job.policy_version)
    env = problem.batch(job.variations)
    trial, shown = 0, env.batch - 1

    def watch(*decision: np.ndarray) -> None:
        if look is not None:
            look(policy, shown, rows[trial][shown], job.variations[shown])

    context = ContextConfig(max=payload.context_max, keep="all", decoder=payload.decoder)
    policy = method.policy(model, env.batch, context, payload.deploy, watch if look else None)
    labeller = None
    if isinstance(payload, LabelledRollouts):
        assert problem.labeller is not None
        labeller = problem.labeller(job, payload.labelling)
    rows = [[Identity(job.stage, job.round, i, k, n) for i, k in job.rows()] for n in range(job.trials)]
    rngs = [[identity.rng(job.seed) for identity in row] for row in rows]
    acting = Exploring(policy, env.spec.actions, payload.explore, payload.explore_from) if payload.explore else policy
    for row, generators, ran in zip(rows, rngs, deploy_online(env, acting, rngs), strict=True):
        if ran.diverged is not None and ran.diverged.any():
            lost = [str(identity) for identity, gone in zip(row, ran.diverged, strict=True) if gone]
            raise RuntimeError(f"{', '.join(lost)}: the simulation diverged, so the episode is not used for training")
        labelled = labeller(row, generators) if labeller else [unlabelled(env.spec)] * len(row)
        for b, identity in enumerate(row):
            yield trajectory(job, identity, ran, b, worker, weights_digest, labelled[b])
        trial = min(trial + 1, job.trials - 1)
