"""What a worker can be asked to do: each job is a function from itself to trajectories."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Protocol

import numpy as np

from icrl_dist import envs
from icrl_dist.behaviour import Walks
from icrl_dist.config import ContextConfig
from icrl_dist.envs.darkroom import cells
from icrl_dist.models.dpt import PretrainedTransformer
from icrl_dist.oracle import Hypotheses, heuristic_labels, soft_labels
from icrl_dist.rollout import Episodes, InContextPolicy, deploy_online, episode, sample
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
    """Contexts D^{i,k} of behaviour policies, query states and their labels (Algorithm 2, lines 8 to 12).

    Settings: ``behaviours``, taken by turns from trial to trial; ``queries`` a trajectory,
    ``labels`` (soft, sampled, heuristic), ``gamma``, ``slack``.
    """
    labeller = _Labeller(job)
    identities = list(job.identities())
    rngs = [identity.rng(job.seed) for identity in identities]
    env = envs.batch([job.variation(identity) for identity in identities])
    behaviours = str(job.setting("behaviours")).split(",")
    kinds = [behaviours[identity.trial % len(behaviours)] for identity in identities]
    ran = episode(env, Walks(labeller.size, env.spec.horizon, kinds, rngs), rngs)
    for row, (identity, rng) in enumerate(zip(identities, rngs, strict=True)):
        yield _trajectory(job, identity, ran, row, worker, "", *labeller(identity, rng))


def adapt(job: Job, policies: Policies, worker: str) -> Iterator[Trajectory]:
    """Online rollouts of T^j in each variation, N + 1 trials each (Algorithm 3, line 12).

    One T^j acts in all trials: the version that the job names.  Settings: ``context_max``;
    ``labels`` and what goes with it, as for ``random_context``, or ``none``: then T^j's own later
    actions become labels, which is the learner's choice to make.
    """
    model, digest = policies.at(job.weights)
    context = ContextConfig(max=int(_number(job, "context_max")), keep="all")
    env = envs.batch(job.variations)
    policy = InContextPolicy(model, env.batch, context)
    labeller = None if job.setting("labels") == "none" else _Labeller(job)
    rows = [[Identity(job.stage, job.round, i, k, n) for i, k in job.rows()] for n in range(job.trials)]
    rngs = [[identity.rng(job.seed) for identity in row] for row in rows]
    nothing = np.zeros((0, env.spec.observation), np.float32), np.zeros((0, env.spec.actions), np.float32), "none"
    for row, chance, ran in zip(rows, rngs, deploy_online(env, policy, rngs), strict=True):
        for b, (identity, rng) in enumerate(zip(row, chance, strict=True)):
            given = labeller(identity, rng) if labeller else nothing
            yield _trajectory(job, identity, ran, b, worker, digest, *given)


class _Labeller:
    """Random query states of a trajectory's variation, and their labels."""

    def __init__(self, job: Job) -> None:
        hypotheses = Hypotheses.of(job.variations)
        self.size = hypotheses.size
        self._mode, self._queries = job.setting("labels"), int(_number(job, "queries"))
        self._place = {row: index for index, row in enumerate(job.rows())}
        self._states = cells(self.size)
        if self._mode == "heuristic":
            self._table = heuristic_labels(hypotheses)
        else:
            self._table = soft_labels(hypotheses, _number(job, "gamma"), _number(job, "slack"))

    def __call__(self, identity: Identity, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray, str]:
        """Query states, labels, and whose the labels are."""
        query = rng.integers(0, len(self._states), size=self._queries)
        labels = self._table[self._place[identity.task, identity.variation], query]
        if self._mode == "sampled":
            labels = np.eye(labels.shape[1], dtype=np.float32)[sample(labels, rng.random(len(query)))]
        return self._states[query], labels, "heuristic" if self._mode == "heuristic" else "optimal"


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
