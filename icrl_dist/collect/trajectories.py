"""A trajectory from an episode and its labels."""

from __future__ import annotations

import numpy as np

from icrl_dist.interfaces import LabelledQueries
from icrl_dist.rollout.episode import Episodes
from icrl_dist.types import Identity, Job, Spec, Trajectory


def trajectory(
    job: Job, identity: Identity, ran: Episodes, row: int, worker: str, weights_digest: str, labelled: LabelledQueries
) -> Trajectory:
    """Row ``row`` of the episodes, as the trajectory of this identity."""
    return Trajectory(
        identity=identity,
        variation=job.variation(identity),
        policy_version=job.policy_version,
        weights_digest=weights_digest,
        worker=worker,
        observations=ran.observations[row],
        actions=ran.actions[row],
        rewards=ran.rewards[row],
        adversary=ran.adversary[row],
        **labelled._asdict(),
    )


def unlabelled(spec: Spec) -> LabelledQueries:
    """No query states and no labels."""
    prev_actions = np.zeros(0, np.int16) if spec.discrete else np.zeros((0, spec.actions), np.float32)
    zeros = np.zeros((0, spec.observation), np.float32), np.zeros((0, spec.actions), np.float32)
    return LabelledQueries(*zeros, prev_actions, np.zeros(0, np.float32), "none")
