"""Pretraining contexts of behavior policies, labelled by the problem (Algorithm 2, lines 8 to 12)."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, ClassVar

from icrl_dist.collect.trajectories import trajectory
from icrl_dist.interfaces import Problem, Progress
from icrl_dist.rollout.episode import episode
from icrl_dist.types import Job, Payload, Trajectory


@dataclass(frozen=True)
class BehaviorContexts(Payload):
    """Episodes of the problem's behavior policies, which are not given the task."""

    kind: ClassVar[str] = "behavior_context"
    needs: ClassVar[tuple[str, ...]] = ("labeller", "behaviors")
    behaviors: tuple[str, ...]
    """Names of the policies; trial n uses name n modulo their number."""
    labelling: Any
    """The problem's ``Labelling``."""


def behavior_contexts(job: Job, problem: Problem, worker: str, progress: Progress) -> Iterator[Trajectory]:
    """Contexts D^{i,k} of behavior policies, with query states and their labels."""
    payload = job.payload
    assert isinstance(payload, BehaviorContexts) and problem.labeller is not None and problem.behaviors is not None
    labeller = problem.labeller(job, payload.labelling)
    identities = list(job.identities())
    rngs = [identity.rng(job.seed) for identity in identities]
    env = problem.batch([job.variation(identity) for identity in identities])
    names = [payload.behaviors[identity.trial % len(payload.behaviors)] for identity in identities]
    ran = episode(env, problem.behaviors.make(names, rngs, env), rngs)
    for row, (identity, labelled) in enumerate(zip(identities, labeller(identities, rngs), strict=True)):
        yield trajectory(job, identity, ran, row, worker, "", labelled)
