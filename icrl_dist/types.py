"""The values that all parts of the system exchange: tasks, adversaries, trajectories, weights, jobs.

All are frozen and use numpy only.  A task with a fixed adversary is a *variation environment*
(section 4.1 of the paper).
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Mapping
from typing import ClassVar, NamedTuple, Self

import numpy as np
from jaxtyping import Bool, Float32, Int16, Shaped

Value = int | float | str | tuple[int, ...] | tuple[float, ...]
Params = tuple[tuple[str, Value], ...]

STAGES = ("pretrain", "adapt", "evaluate")


def _params(values: Mapping[str, object]) -> Params:
    """Sorted ``(name, value)`` pairs, so that equal parameters are equal values."""
    pairs: list[tuple[str, Value]] = []
    for name, value in sorted(values.items()):
        if isinstance(value, (list, tuple, np.ndarray)):
            flat = tuple(v.item() if isinstance(v, np.generic) else v for v in value)
            if not all(isinstance(v, (int, float)) for v in flat):
                raise TypeError(f"parameter {name}={value!r} is not a flat list of numbers")
            pairs.append((name, flat))
        elif isinstance(value, np.generic):
            pairs.append((name, value.item()))
        elif isinstance(value, (int, float, str)):
            pairs.append((name, value))
        else:
            raise TypeError(f"parameter {name}={value!r} must be a number, a string or a flat list")
    return tuple(pairs)


@dataclasses.dataclass(frozen=True, slots=True)
class _Named:
    """A kind and its parameters: plain data, so that it can be sent and stored."""

    kind: str
    params: Params = ()

    @classmethod
    def of(cls, kind: str, /, **params: object) -> Self:
        return cls(kind, _params(params))

    def __getitem__(self, name: str) -> Value:
        for key, value in self.params:
            if key == name:
                return value
        known = ", ".join(key for key, _ in self.params) or "none"
        raise KeyError(f"{self.kind} has no parameter {name!r}; it has: {known}")

    def get(self, name: str, default: Value) -> Value:
        return dict(self.params).get(name, default)

    def vector(self, name: str) -> tuple[float, ...]:
        """The parameter as a tuple of numbers.  Raises TypeError if it is not one."""
        value = self[name]
        if not isinstance(value, tuple):
            raise TypeError(f"{self.kind}: {name}={value!r} is not a list of numbers")
        return value

    def number(self, name: str) -> float:
        """The parameter as one number.  Raises TypeError if it is not one."""
        value = self[name]
        if isinstance(value, bool) or not isinstance(value, (int, float)):
            raise TypeError(f"{self.kind}: {name}={value!r} is not a number")
        return value

    def replace(self, **params: object) -> Self:
        return type(self)(self.kind, _params({**dict(self.params), **params}))


class Task(_Named):
    """An MDP tau: the problem's name (``kind``) and its parameters.

    ``Task.of("darkroom", size=10, horizon=100, goal=(3, 4))``.
    """

    __slots__ = ()


class Adversary(_Named):
    """A fixed disturbance policy phi: its family (``kind``) and its parameters."""

    __slots__ = ()


NULL = Adversary("null")
"""phi_0: the adversary that does nothing; whether training has it too is ``adversary.null`` (section 4.1)."""


@dataclasses.dataclass(frozen=True, slots=True)
class Variation:
    """A variation environment (tau, phi) of the augmented task space M_v."""

    task: Task
    adversary: Adversary = NULL


@dataclasses.dataclass(frozen=True, slots=True)
class Split:
    """The training tasks and the test tasks of a problem; methods train on ``train`` only."""

    train: tuple[Task, ...]
    test: tuple[Task, ...]


@dataclasses.dataclass(frozen=True, slots=True)
class Spec:
    """Shape of an environment's observations and actions, and its horizon.

    A checkpoint contains the spec it was trained for and refuses environments with another.
    """

    low: tuple[float, ...]
    """Smallest value of each observation component, in the environment's own unit."""
    high: tuple[float, ...]
    """Largest value of each observation component."""
    actions: int
    """Number of discrete actions, or the action's dimension if ``discrete`` is false."""
    horizon: int
    """Steps per episode, H."""
    discrete: bool = True

    @property
    def observation(self) -> int:
        """Number of observation components, S."""
        return len(self.low)


class Identity(NamedTuple):
    """Names a trajectory, in the same way everywhere: on the wire, in the index, in seeds and in leases."""

    stage: str
    round: int
    task: int
    variation: int
    trial: int

    def key(self) -> tuple[int, ...]:
        """The identity as integers: the canonical order, and the spawn key of the trajectory's seeds."""
        return (STAGES.index(self.stage), self.round, self.task, self.variation, self.trial)

    @property
    def next_version(self) -> int:
        """First policy version that is fitted to this trajectory: 0 for ``pretrain``, j + 1 for round j."""
        return self.round + 1 if self.stage == "adapt" else 0

    def rng(self, seed: int, *what: int) -> np.random.Generator:
        """The random generator of this trajectory, or of the part ``what`` of its draws; it is the same on any worker."""
        return np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(*self.key(), *what)))

    def __str__(self) -> str:
        return "/".join(map(str, self))

    @classmethod
    def parse(cls, text: str) -> Identity:
        """The inverse of ``str``.  Raises ValueError with the expected form."""
        parts = text.split("/")
        if len(parts) != 5 or parts[0] not in STAGES or not all(p.isascii() and p.isdigit() for p in parts[1:]):
            raise ValueError(f"identity {text!r}: expected STAGE/ROUND/TASK/VARIATION/TRIAL, STAGE one of {STAGES}")
        return cls(parts[0], *map(int, parts[1:]))


class Step(NamedTuple):
    """One step of a batch of B environments."""

    observation: Float32[np.ndarray, "B S"]
    reward: Float32[np.ndarray, " B"]
    done: bool
    """Whether the horizon was reached: all environments of a batch end together."""
    adversary: Int16[np.ndarray, " B"] | Float32[np.ndarray, "B F"]
    """The action that the adversary executed instead of the agent's, or the direction of its wind; -1 where it did
    nothing.  With vector actions the adversary's own action, 0 where there is no adversary."""
    diverged: Bool[np.ndarray, " B"] | None = None
    """Rows whose simulation has broken down in this episode, which must not be used for training.
    None if the environment cannot break down."""


@dataclasses.dataclass(frozen=True, slots=True, eq=False)
class Trajectory:
    """An episode xi_n in one variation environment, with labelled query states.

    The worker that collects it also computes the labels, so expert policies are never sent.
    """

    identity: Identity
    variation: Variation
    policy_version: int
    """Version of the weights that selected the actions; -1 for a policy without weights."""
    weights_digest: str
    """SHA-256 of those weights; empty for a policy without weights."""
    worker: str
    actions: Int16[np.ndarray, " H"] | Float32[np.ndarray, "H A"]
    """Integers for discrete actions, else vectors in [-1, 1]."""
    observations: Float32[np.ndarray, "H+1 S"]
    rewards: Float32[np.ndarray, " H"]
    adversary: Int16[np.ndarray, " H"] | Float32[np.ndarray, "H F"]
    """See ``Step.adversary``: integers for discrete actions, else vectors."""
    queries: Float32[np.ndarray, "Q S"]
    """Query states s_query; none (Q = 0) if there are no labels."""
    labels: Float32[np.ndarray, "Q A"]
    """A distribution over discrete actions at each query state; for vector actions the right action."""
    prev_actions: Int16[np.ndarray, " R"] | Float32[np.ndarray, "R A"]
    """Actions at the last R query states, which form action windows (zeta_h of eq. 6), one window after another.
    At a state of a window the model reads those before it.  The first Q - R query states belong to no window."""
    prev_rewards: Float32[np.ndarray, " R"]
    """Reward after each of these actions."""
    origin: str
    """Source of the labels: ``optimal``, ``heuristic``, ``expert`` or ``none``."""

    @property
    def episode_return(self) -> float:
        return float(self.rewards.sum())

    def arrays(self) -> dict[str, np.ndarray]:
        """Every array by name, in the order of the wire format, the dataset and the digest."""
        return {name: getattr(self, name) for name in ARRAYS}


ARRAYS: dict[str, tuple[str, int]] = {
    "observations": ("<f4", 2),
    "actions": ("<i2", 1),
    "rewards": ("<f4", 1),
    "adversary": ("<i2", 1),
    "queries": ("<f4", 2),
    "labels": ("<f4", 2),
    "prev_actions": ("<i2", 1),
    "prev_rewards": ("<f4", 1),
}
"""A trajectory's arrays with discrete actions: dtype and number of dimensions."""
VECTORS: dict[str, tuple[str, int]] = ARRAYS | dict.fromkeys(("actions", "adversary", "prev_actions"), ("<f4", 2))
"""The same with vector actions."""


@dataclasses.dataclass(frozen=True, slots=True, eq=False)
class Weights:
    """The parameters of one policy version; version j is the model T^j."""

    version: int
    arrays: Mapping[str, Shaped[np.ndarray, "..."]]
    digest: str


class LabelCounts(NamedTuple):
    """The labels that a job asks for in each of its trajectories."""

    queries: int
    """Query states, Q."""
    window_steps: int
    """Those of them that belong to action windows, R."""
    origin: str
    """Their source: see ``Trajectory.origin``."""


@dataclasses.dataclass(frozen=True)
class Payload:
    """Settings of one kind of job; each kind has its own subclass, which is decoded strictly."""

    kind: ClassVar[str] = ""
    """Name of the kind."""
    needs: ClassVar[tuple[str, ...]] = ()
    """Optional parts of ``Problem`` that a job of this kind needs."""
    arrives_at_once: ClassVar[bool] = False
    """Whether all trajectories of a job arrive together, after hours of training or immediately from a cache.
    The time between two trajectories then does not predict when the next one arrives."""

    @property
    def labels(self) -> LabelCounts | None:
        """The labels of each trajectory: ``label_counts`` of the payload's ``labelling``; None where that does not say."""
        found: LabelCounts | None = getattr(getattr(self, "labelling", None), "label_counts", None)
        return found

    def env_steps(self, trials: int, horizon: int) -> int:
        """Environment steps of a job in each variation: its trials, and the action windows of each."""
        windows = self.labels.window_steps if self.labels else 0
        return trials * (horizon + windows)


@dataclasses.dataclass(frozen=True, slots=True)
class Job:
    """A fixed batch of work: all variations of a few tasks, for a number of trials.

    The job fixes the batch of environments, so floating-point results do not depend on which
    worker does which job.
    """

    kind: str
    """Which function does the job: see ``collect.kinds``, and ``Problem.job_kinds``."""
    stage: str
    round: int
    task: int
    """Number of the first task."""
    variations: tuple[Variation, ...]
    """The variations of the first task, then those of the next, and so on."""
    trials: int
    """Episodes in each variation."""
    policy_version: int
    """Version of the weights that select the actions; -1 for a policy without weights."""
    seed: int
    payload: Payload = Payload()
    """Settings of this kind of job."""
    tasks: int = 1
    """Number of consecutive tasks."""
    first: int = 0
    """Number of the first variation within its task; above 0 in a job with only some variations of one task."""

    def rows(self) -> list[tuple[int, int]]:
        """For each of ``variations`` the number of its task, and its own number within the task."""
        count = len(self.variations) // self.tasks
        return [(self.task + row // count, self.first + row % count) for row in range(len(self.variations))]

    def identities(self) -> Iterable[Identity]:
        """The identities of all trajectories of this job."""
        for task, variation in self.rows():
            for trial in range(self.trials):
                yield Identity(self.stage, self.round, task, variation, trial)

    def variation(self, identity: Identity) -> Variation:
        """The variation environment that a trajectory of this job comes from."""
        count = len(self.variations) // self.tasks
        return self.variations[(identity.task - self.task) * count + identity.variation - self.first]

    @property
    def name(self) -> tuple[str, int, int, int]:
        """Stage, round, first task, and first variation within it."""
        return (self.stage, self.round, self.task, self.first)

    @property
    def label(self) -> str:
        """The name as text: ``adapt/0/3``, or ``adapt/0/3/2`` for a job with a single variation."""
        return "/".join(map(str, self.name if len(self.variations) == 1 else self.name[:3]))
