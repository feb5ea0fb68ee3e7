"""What a worker can be asked to do: each job is a function from itself to trajectories."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Protocol

import numpy as np

from icrl_dist import envs
from icrl_dist.config import ContextConfig
from icrl_dist.envs.darkroom import cells
from icrl_dist.models.dpt import PretrainedTransformer
from icrl_dist.oracle import Hypotheses, heuristic_labels, soft_labels
from icrl_dist.rollout import Episodes, InContextPolicy, RandomPolicy, deploy_online, episode, sample
from icrl_dist.types import Identity, Job, Trajectory


class Policies(Protocol):
    """Where a job finds the weights that it names."""

    def at(self, version: int) -> tuple[PretrainedTransformer, str]:
        """The model of exactly this version, and its digest; waits until it is there."""
        ...


def do(job: Job, policies: Policies, worker: str) -> Iterator[Trajectory]:
    """Do the job, yielding each trajectory when its episode ends.

    Raises ValueError for a job of an unknown kind.
    """
    if job.kind == "random_context":
        return random_context(job, worker)
    if job.kind == "adapt":
        return adapt(job, policies, worker)
    raise ValueError(f"job kind {job.kind!r}: this worker knows random_context and adapt")


def random_context(job: Job, worker: str) -> Iterator[Trajectory]:
    """Random-policy contexts D^{i,k}, query states and their labels (Algorithm 2, lines 8 to 12).

    Settings: ``queries`` a trajectory, ``labels`` (soft, sampled, heuristic), ``gamma``,
    ``slack``.
    """
    hypotheses = Hypotheses.of(job.variations)
    place = {row: index for index, row in enumerate(job.rows())}
    mode = job.setting("labels")
    if mode == "heuristic":
        table = heuristic_labels(hypotheses)
    else:
        table = soft_labels(hypotheses, _number(job, "gamma"), _number(job, "slack"))
    states = cells(hypotheses.size)
    identities = list(job.identities())
    rngs = [identity.rng(job.seed) for identity in identities]
    env = envs.batch([job.variation(identity) for identity in identities])
    ran = episode(env, RandomPolicy(env.spec.actions), rngs)
    for row, (identity, rng) in enumerate(zip(identities, rngs, strict=True)):
        query = rng.integers(0, len(states), size=int(_number(job, "queries")))
        labels = table[place[identity.task, identity.variation], query]
        if mode == "sampled":
            labels = np.eye(env.spec.actions, dtype=np.float32)[sample(labels, rng.random(len(query)))]
        origin = "heuristic" if mode == "heuristic" else "optimal"
        yield _trajectory(job, identity, ran, row, worker, "", states[query], labels, origin)


def adapt(job: Job, policies: Policies, worker: str) -> Iterator[Trajectory]:
    """Online rollouts of T^j in each variation, N + 1 trials each (Algorithm 3, line 12).

    One T^j acts in all trials: the version that the job names.  Its own later actions become
    labels, which is the learner's choice to make, so none are written here.
    """
    model, digest = policies.at(job.weights)
    context = ContextConfig(max=int(_number(job, "context_max")), keep="all")
    env = envs.batch(job.variations)
    policy = InContextPolicy(model, env.batch, context)
    rows = [[Identity(job.stage, job.round, i, k, n) for i, k in job.rows()] for n in range(job.trials)]
    trials = ([identity.rng(job.seed) for identity in row] for row in rows)
    nothing = np.zeros((0, env.spec.observation), np.float32), np.zeros((0, env.spec.actions), np.float32)
    for row, ran in zip(rows, deploy_online(env, policy, trials), strict=True):
        for b, identity in enumerate(row):
            yield _trajectory(job, identity, ran, b, worker, digest, *nothing, "none")


def _number(job: Job, name: str) -> float:
    value = job.setting(name)
    if not isinstance(value, (int, float)):
        raise TypeError(f"job {job.name}: setting {name}={value!r} is not a number")
    return value


def _trajectory(
    job: Job,
    identity: Identity,
    ran: Episodes,
    row: int,
    worker: str,
    digest: str,
    queries: np.ndarray,
    labels: np.ndarray,
    origin: str,
) -> Trajectory:
    return Trajectory(
        identity=identity,
        variation=job.variation(identity),
        weights=job.weights,
        digest=digest,
        worker=worker,
        observations=ran.observations[row],
        actions=ran.actions[row],
        rewards=ran.rewards[row],
        adversary=ran.adversary[row],
        queries=queries,
        labels=labels,
        origin=origin,
    )
