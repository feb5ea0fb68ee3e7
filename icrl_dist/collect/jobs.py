"""What a worker can be asked to do: each job is a function from itself to trajectories."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from typing import NamedTuple, Protocol, cast

import numpy as np
from jaxtyping import Float32, Int, Int16

from icrl_dist.config.run import ContextConfig, Deployment
from icrl_dist.experts.train import Tell, train_expert, unheard
from icrl_dist.models.dpt import PretrainedTransformer
from icrl_dist.models.heads import sample
from icrl_dist.problems import registry
from icrl_dist.problems.darkroom.behavior_policies import Walks
from icrl_dist.problems.darkroom.exact_agents import OptimalAgent
from icrl_dist.problems.darkroom.room import cells
from icrl_dist.problems.darkroom.solver import Hypotheses, cell_numbers, heuristic_labels, soft_labels
from icrl_dist.problems.metaworld.scripted_contexts import scripted_context
from icrl_dist.rollout.deployment import Episodes, InContextPolicy, deploy_online, episode, in_context
from icrl_dist.types import Identity, Job, Spec, Trajectory, Variation


class Policies(Protocol):
    """Where a job finds the weights that it names."""

    def at(self, version: int) -> tuple[PretrainedTransformer, str]:
        """The model of exactly this version, and its digest; waits until it is there."""
        ...


Look = Callable[[InContextPolicy, int, Identity, Variation], None]
"""Shown T_theta after every decision of one of its environments: the policy, the environment's row, identity and variation."""


def do(job: Job, policies: Policies, worker: str, tell: Tell = unheard, look: Look | None = None) -> Iterator[Trajectory]:
    """Do the job, yielding each trajectory when its episode ends.

    ``tell`` hears of what takes long before that; ``look`` sees T_theta at work, and must leave it as it is.

    Raises ValueError for a job of an unknown kind.
    """
    if job.kind == "random_context":
        return random_context(job, worker)
    if job.kind == "train_expert":
        return train_expert(job, worker, tell)
    if job.kind == "scripted_context":
        return scripted_context(job, worker, tell)
    if job.kind == "adapt":
        return adapt(job, policies, worker, look)
    raise ValueError(f"job kind {job.kind!r}: this worker knows random_context, train_expert, scripted_context, adapt")


def random_context(job: Job, worker: str) -> Iterator[Trajectory]:
    """Contexts D^{i,k} of behavior policies, query states and their labels (Algorithm 2, lines 8 to 12).

    Settings: ``behaviors``, taken by turns from trial to trial; ``queries`` a trajectory,
    ``labels`` (soft, sampled, heuristic), ``gamma``, ``slack``; ``windows`` a trajectory, of
    ``window`` states.
    """
    labeller = _Labeller(job)
    identities = list(job.identities())
    rngs = [identity.rng(job.seed) for identity in identities]
    env = registry.batch([job.variation(identity) for identity in identities])
    behaviors = str(job.setting("behaviors")).split(",")
    kinds = [behaviors[identity.trial % len(behaviors)] for identity in identities]
    ran = episode(env, Walks(labeller.size, env.spec.horizon, kinds, rngs), rngs)
    for row, (identity, known) in enumerate(zip(identities, labeller(identities, rngs), strict=True)):
        yield _trajectory(job, identity, ran, row, worker, "", known)


def adapt(job: Job, policies: Policies, worker: str, look: Look | None = None) -> Iterator[Trajectory]:
    """Online rollouts of T^j in each variation, N + 1 trials each (Algorithm 3, line 12).

    One T^j acts in all trials: the version that the job names.  Settings: ``context_max``, ``deploy``;
    ``labels`` and what goes with it, as for ``random_context``, or ``none``: then T^j's own later
    actions become labels, which is the learner's choice to make.
    """
    model, digest = policies.at(job.policy_version)
    context = ContextConfig(max=int(_number(job, "context_max")), keep="all")
    env = registry.batch(job.variations)
    trial, shown = 0, env.batch - 1

    def watch(*decision: np.ndarray) -> None:
        if look is not None:
            look(policy, shown, rows[trial][shown], job.variations[shown])

    policy = in_context(model, env.batch, context, cast(Deployment, job.setting("deploy")), watch if look else None)
    labeller = None if job.setting("labels") == "none" else _Labeller(job)
    rows = [[Identity(job.stage, job.round, i, k, n) for i, k in job.rows()] for n in range(job.trials)]
    rngs = [[identity.rng(job.seed) for identity in row] for row in rows]
    for row, chance, ran in zip(rows, rngs, deploy_online(env, policy, rngs), strict=True):
        if ran.diverged is not None and ran.diverged.any():
            lost = [str(identity) for identity, gone in zip(row, ran.diverged, strict=True) if gone]
            raise RuntimeError(f"{', '.join(lost)}: the simulation broke down, and nothing may be learned from it")
        known = labeller(row, chance) if labeller else [_nothing(env.spec)] * len(row)
        for b, identity in enumerate(row):
            yield _trajectory(job, identity, ran, b, worker, digest, known[b])
        trial = min(trial + 1, job.trials - 1)


class _Known(NamedTuple):
    """What a trajectory's collector knew better: its last fields."""

    queries: Float32[np.ndarray, "Q S"]
    labels: Float32[np.ndarray, "Q A"]
    taken: Int16[np.ndarray, " R"] | Float32[np.ndarray, "R A"]
    gained: Float32[np.ndarray, " R"]
    origin: str


def _nothing(spec: Spec) -> _Known:
    zeros = np.zeros((0, spec.observation), np.float32), np.zeros((0, spec.actions), np.float32)
    taken = _NO_WINDOW[0] if spec.discrete else np.zeros((0, spec.actions), np.float32)
    return _Known(*zeros, taken, _NO_WINDOW[1], "none")


_NO_WINDOW = np.zeros(0, np.int16), np.zeros(0, np.float32)


class _Labeller:
    """Random query states of a trajectory's variation, windows from random states on, and their labels."""

    def __init__(self, job: Job) -> None:
        self._job = job
        self._hypotheses = Hypotheses.of(job.variations)
        self.size = self._hypotheses.size
        self._mode, self._queries = job.setting("labels"), int(_number(job, "queries"))
        self._windows, self._length = int(_number(job, "windows")), int(_number(job, "window"))
        self._place = {row: index for index, row in enumerate(job.rows())}
        self._states = cells(self.size)
        if self._mode == "heuristic":
            self._table = heuristic_labels(self._hypotheses)
        else:
            self._table = soft_labels(self._hypotheses, _number(job, "gamma"), _number(job, "slack"))
        if self._windows:
            self._decoys = self._undisturbed(job)

    def _undisturbed(self, job: Job) -> Float32[np.ndarray, "M C A"]:
        """The optimal policies of the undisturbed tasks that may be guessed."""
        cells = job.setting("decoys")
        assert isinstance(cells, tuple)
        tasks = [job.variations[0].task.replace(goal=divmod(int(cell), self.size)) for cell in cells]
        hypotheses = Hypotheses.of([Variation(task) for task in tasks])
        return soft_labels(hypotheses, _number(job, "gamma"), _number(job, "slack"))

    def __call__(self, identities: Sequence[Identity], rngs: Sequence[np.random.Generator]) -> list[_Known]:
        place = np.array([self._place[identity.task, identity.variation] for identity in identities])
        alone = [self._alone(p, rng) for p, rng in zip(place.tolist(), rngs, strict=True)]
        if not self._windows:
            return alone
        states, taken, gained = self._follow(place, rngs)
        labels = self._table[place[:, None], cell_numbers(states, self.size)]
        if self._mode == "sampled":
            chance = np.stack([rng.random(labels.shape[1]) for rng in rngs])
            labels = np.eye(labels.shape[2], dtype=np.float32)[[sample(*row) for row in zip(labels, chance, strict=True)]]
        return [
            _Known(
                np.concatenate([one.queries, states[b]]),
                np.concatenate([one.labels, labels[b]]),
                taken[b],
                gained[b],
                one.origin,
            )
            for b, one in enumerate(alone)
        ]

    def _alone(self, place: int, rng: np.random.Generator) -> _Known:
        query = rng.integers(0, len(self._states), size=self._queries)
        labels = self._table[place, query]
        if self._mode == "sampled":
            labels = np.eye(labels.shape[1], dtype=np.float32)[sample(labels, rng.random(len(query)))]
        origin = "heuristic" if self._mode == "heuristic" else "optimal"
        return _Known(self._states[query], labels, *_NO_WINDOW, origin)

    def _follow(
        self, place: Int[np.ndarray, " B"], rngs: Sequence[np.random.Generator]
    ) -> tuple[Float32[np.ndarray, "B R S"], Int16[np.ndarray, "B R"], Float32[np.ndarray, "B R"]]:
        """States, actions and rewards of each row's windows, one after another, from random states on.

        The labelling policy acts, or that of a wrong guess.
        """
        decoy_fraction, windows, decoys = _number(self._job, "decoy_fraction"), self._windows, len(self._decoys)
        drawn = [(rng.random(windows), rng.integers(0, decoys, size=windows)) for rng in rngs]
        wrong, decoy = (np.concatenate(column) for column in zip(*drawn, strict=True))
        rows = place.repeat(windows)
        policy = np.where((wrong < decoy_fraction)[:, None, None], self._decoys[decoy], self._table[rows])
        short = [self._job.variations[p] for p in rows.tolist()]
        short = [Variation(v.task.replace(start="random", horizon=self._length), v.adversary) for v in short]
        chance = [rng for rng in rngs for _ in range(windows)]
        ran = episode(registry.batch(short), OptimalAgent(policy, self.size), chance)
        states = ran.observations[:, :-1].reshape(len(place), windows * self._length, -1)
        return states, ran.actions.reshape(len(place), -1), ran.rewards.reshape(len(place), -1)


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
    known: _Known,
) -> Trajectory:
    return Trajectory(
        identity=identity,
        variation=job.variation(identity),
        policy_version=job.policy_version,
        weights_digest=digest,
        worker=worker,
        observations=ran.observations[row],
        actions=ran.actions[row],
        rewards=ran.rewards[row],
        adversary=ran.adversary[row],
        **known._asdict(),
    )
