"""The five interfaces of the system: ``Problem``, ``Method``, ``Policy``, ``Batch`` and ``Link``.

The loop of a rollout worker (``actors/worker.py``)::

    run = ask("hello")
    problem, method = problems.of(run), methods.of(run)
    while (job := ask("lease")) is not None:
        for trajectory in collect.do(job, problem, method, weights):
            send(encode(trajectory))              # kept until the learner has stored it

The loop of the central learner (``learner/service.py``)::

    for phase in method.phases(run):
        scheduler.open(method.ask(run, phase))    # workers lease these jobs
        while not scheduler.done(phase):          # ingest stores what they send
            wait()
        draw = method.data(run, phase, dataset)
        for step in range(phase.steps):
            method.loss(model, draw(rng(step))).backward()
            optimizer.step()
        publish(weights(model))                   # the policy version of the next round

Everything else knows a problem or a method only through these interfaces.  A problem or a method of
another package is found through the entry point groups ``icrl_dist.problems`` and ``icrl_dist.methods``.
"""

from __future__ import annotations

import abc
import functools
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar, NamedTuple, Protocol

import numpy as np
from jaxtyping import Float, Float32, Float64, Int, Int16, Int64

from icrl_dist.stream.link import Link
from icrl_dist.types import Adversary, Identity, Job, Payload, Spec, Split, Step, Task, Trajectory, Variation

if TYPE_CHECKING:
    import torch

    from icrl_dist.config.run import Deployment, Run
    from icrl_dist.config.sections import AdversaryConfig, ContextConfig
    from icrl_dist.problems.benchmarks import Benchmarks

__all__ = ["Batch", "Link", "Method", "Policy", "Problem"]

Actions = Int64[np.ndarray, " B"] | Float32[np.ndarray, "B A"]
"""Actions in B environments: numbers, or vectors in [-1, 1]."""

Progress = Callable[..., None]
"""``progress(text, note=False, reached=0)``: called during work that takes long.

A ``note`` deserves a line of its own.  ``reached`` is how far the work is: a worker that repeats the work
after a crash and gets further than before is not to blame for the crash.
"""


def no_progress(text: str, note: bool = False, reached: int = 0) -> None:
    """Report nothing."""


class Batch(Protocol):
    """B variation environments stepped together; each row draws from its own generator."""

    spec: Spec
    batch: int

    def reset(self, rngs: Sequence[np.random.Generator]) -> Float[np.ndarray, "B S"]:
        """Start an episode in every row."""
        ...

    def step(self, actions: Int[np.ndarray, " B"] | Float32[np.ndarray, "B A"]) -> Step:
        """Act in every row.  Raises RuntimeError past the horizon."""
        ...


class Policy(Protocol):
    """Acts in B environments at once and learns of them from ``observe`` alone."""

    def act(self, observation: Float32[np.ndarray, "B S"], u: Float[np.ndarray, "B U"]) -> Actions:
        """The actions that the uniform numbers ``u`` in [0, 1) select: one number a row, or one a component."""
        ...

    def observe(
        self,
        observation: Float32[np.ndarray, "B S"],
        action: Actions,
        reward: Float32[np.ndarray, " B"],
        next_observation: Float32[np.ndarray, "B S"],
        done: bool,
    ) -> None:
        """Take in one transition of every environment."""
        ...


MakePolicy = Callable[[Sequence[Variation], Batch], Policy]
"""A policy for these variations, which act in this batch of environments."""

Watch = Callable[..., object]
"""Called after every decision of an in-context policy with the decision and its outcome.

Arguments: the model's final state (B, D), observation, action, reward, next observation.
"""


class LabelledQueries(NamedTuple):
    """Query states of one trajectory with their labels, and action windows (zeta of eq. 6)."""

    queries: Float32[np.ndarray, "Q S"]
    labels: Float32[np.ndarray, "Q A"]
    taken: Int16[np.ndarray, " R"] | Float32[np.ndarray, "R A"]
    """Actions at the last R query states, which form action windows."""
    gained: Float32[np.ndarray, " R"]
    """Reward that each of these actions brought."""
    origin: str
    """Where the labels come from: see ``Trajectory.origin``."""


Labeller = Callable[[Sequence[Identity], Sequence[np.random.Generator]], list[LabelledQueries]]
"""Draws query states for each of these trajectories, with its own generator, and labels them."""


@dataclass(frozen=True)
class Contexts:
    """How a problem collects the contexts of the pretraining dataset."""

    payload: Payload
    """What the collecting jobs carry."""
    most_trials: int | None = None
    """Most episodes that one variation can give; None for any number."""


@dataclass(frozen=True)
class Reference:
    """An agent that stands beside the models in every table."""

    make: MakePolicy
    ceiling: bool = False
    """It knows the task: returns are also shown as a share of this agent's."""


JobFunction = Callable[[Job, "Problem", str, Progress], Iterator[Trajectory]]
"""``function(job, problem, worker, progress)``: does a job and yields each trajectory when its episode ends."""


class JobKind(NamedTuple):
    """One kind of job that needs no model: its payload and the function that does it."""

    payload: type[Payload]
    do: JobFunction


class ExactAnswers(Protocol):
    """Exact answers for variations: a part of problems that can be solved."""

    def optimum(self, variations: Sequence[Variation]) -> Float64[np.ndarray, " M"]:
        """Expected undiscounted return of the optimal policy from the start of a test episode."""
        ...

    def optimal(
        self, variation: Variation, states: Float32[np.ndarray, "Q S"], labels: Float32[np.ndarray, "Q A"]
    ) -> Float[np.ndarray, " Q"]:
        """1 where the most probable action of a label is optimal at its state, else 0."""
        ...

    def agent(self, run: Run, rule: str) -> MakePolicy:
        """The exact agent that acts by posterior sampling (Theorem E.3), deployed by this rule."""
        ...


class BeliefReader(Protocol):
    """Reads what an in-context policy's distributions imply about the task of one variation."""

    def message(self, policy: Any, row: int) -> dict[str, Any]:
        """Fields of a ``belief`` message of the monitor plane (docs/tap.md)."""
        ...


MakeBehavior = Callable[[Sequence[str], Sequence[np.random.Generator], Batch], Policy]
MakeDrawing = Callable[[np.ndarray, np.ndarray, Mapping[str, Any], int], dict[str, Any]]


class Problem(abc.ABC):
    """A family of tasks with its adversaries, made from one section of a run file.

    It owns the split into training and test tasks, the environments, the adversaries, where labels
    come from, and which agents stand beside a model.  A part that a problem does not have is None:
    callers ask for the part, never for the name.
    """

    section: ClassVar[str]
    """Name of its section in a run file."""
    Config: ClassVar[type]
    """Frozen dataclass of that section; every field has a default."""
    Labelling: ClassVar[type]
    """Frozen dataclass: what a job needs to label query states; see ``labelling``."""
    template: ClassVar[str] = ""
    """Packaged run file that problems of this class share, if any: ``dmc`` for ``dmc.toml`` and ``dmc-laptop.toml``."""
    free_in_forks: ClassVar[tuple[str, ...]] = ()
    """Fields of the section that a fork may change: they decide neither the tasks nor their split."""
    job_kinds: ClassVar[Mapping[str, JobKind]] = {}
    """Kinds of jobs that only this problem has."""
    earns_in_contexts: ClassVar[bool] = True
    """Whether the episodes of pretraining contexts should have returns above 0; if not, zeros are no alert."""

    def __init__(self, name: str, config: Any) -> None:
        """``name`` as in a run file; ``config``: its section."""
        self.name, self.config = name, config

    @abc.abstractmethod
    def spec_of(self, task: Task) -> Spec:
        """Shape of a task's observations and actions.  Raises ValueError for an impossible task."""

    @abc.abstractmethod
    def make_split(self) -> Split:
        """The tasks to train on and the tasks to test on, by the section alone; see ``split``."""

    @abc.abstractmethod
    def batch(self, variations: Sequence[Variation]) -> Batch:
        """These variation environments as one batch."""

    @abc.abstractmethod
    def training_adversaries(self, rng: np.random.Generator, config: AdversaryConfig) -> tuple[Adversary, ...]:
        """K adversaries of one training task, phi_0 first (section 4.1)."""

    @abc.abstractmethod
    def test_adversary(self, rng: np.random.Generator, strength: float, prior: str) -> Adversary:
        """An adversary that was never trained on, of a strength above 0 (``evaluate.p``)."""

    @abc.abstractmethod
    def labelling(self, run: Run) -> Any:
        """The ``Labelling`` of this run's jobs."""

    @abc.abstractmethod
    def contexts(self, run: Run) -> Contexts:
        """How pretraining contexts are collected."""

    @abc.abstractmethod
    def references(self, run: Run) -> dict[str, Reference]:
        """The agents beside a model, by the name that tables show, in the tables' order."""

    # Optional parts.  A problem that has a part overrides the property.

    @property
    def exact(self) -> ExactAnswers | None:
        """Exact answers."""
        return None

    @property
    def labeller(self) -> Callable[[Job, Any], Labeller] | None:
        """``labeller(job, labelling)`` labels any new history of the job's variations."""
        return None

    @property
    def behavior(self) -> MakeBehavior | None:
        """``behavior(names, rngs, env)``: one named behavior policy a row, for pretraining contexts."""
        return None

    @property
    def scripted(self) -> Callable[[Float[np.ndarray, "N T"]], Float32[np.ndarray, "N A"]] | None:
        """A scripted policy of the true states, which ``Batch.truth`` gives."""
        return None

    @property
    def belief(self) -> Callable[[Variation], BeliefReader] | None:
        """What an in-context policy believes of a variation's task, for live views."""
        return None

    @property
    def drawing(self) -> MakeDrawing | None:
        """``drawing(states, adversary, task, every)``: an episode as numbers that live views draw (docs/tap.md).

        ``states``: every ``every``-th observation; ``adversary``: the adversary's action or strength at each;
        ``task``: its parameters.  Raises ValueError for an episode that cannot be drawn.
        """
        return None

    @property
    def message_optimum(self) -> Callable[[Mapping[str, Any], Mapping[str, Any]], float | None] | None:
        """``message_optimum(task, adversary)``: optimal return of a variation from a monitor message's fields."""
        return None

    @property
    def posterior(self) -> Any:
        """Comparison of a model with the exact posterior (``icrl-dist evaluate --suite posterior``)."""
        return None

    @property
    def game(self) -> Any:
        """What ``icrl-dist play`` plays."""
        return None

    @property
    def benchmarks(self) -> Benchmarks | None:
        """What ``icrl-dist bench`` needs of the problem; None for a problem that no benchmark measures."""
        return None

    @functools.cached_property
    def split(self) -> Split:
        """The tasks to train on and the tasks to test on."""
        return self.make_split()

    @functools.cached_property
    def spec(self) -> Spec:
        """The spec that all of the problem's tasks share."""
        return self.spec_of(self.split.train[0])

    @property
    def horizon(self) -> int:
        """Steps an episode, H."""
        return self.spec.horizon

    @property
    def train_count(self) -> int:
        """Number of training tasks."""
        return len(self.split.train)

    @property
    def evaluated(self) -> tuple[Task, ...]:
        """The tasks of online evaluation: those that were never trained on."""
        return self.split.test

    def at_test_start(self, task: Task) -> Task:
        """The task with the start that test episodes have."""
        return task

    def resolved(self) -> Any:
        """The section with what its symbolic values come to written beside them, so that later tables cannot change a run.

        Raises ConfigError for a value that cannot be resolved.
        """
        return self.config

    def objections(self, run: Run) -> Iterator[tuple[str, object, str]]:
        """What is impossible in a run of this problem: the key, its value, the remedy."""
        yield from ()

    def missing_reference(self, run: Run, what: str) -> str:
        """Why an agent that should stand beside the models does not, and the remedy; empty if none is missing."""
        return ""

    def title(self, tasks: int) -> str:
        """The evaluated tasks in words, for titles: ``20 held-out goals of a 10x10 Dark Room``."""
        return f"{tasks} held-out tasks of {self.name}"

    def manifest(self) -> dict[str, Any]:
        """What a checkpoint says of the problem and its split, as plain values."""
        plain = [[dict(task.params) for task in part] for part in (self.split.train, self.split.test)]
        return {"train_tasks": plain[0], "test_tasks": plain[1]}


@dataclass(frozen=True)
class Phase:
    """Collect, then fit: one pass through the learner's loop."""

    stage: str
    round: int
    steps: int
    """Optimizer steps of the fit."""
    learning_rate: float
    """Peak learning rate of the fit."""

    @property
    def policy_version(self) -> int:
        """Version of the weights that act: T^j in round j of ``adapt``, none (-1) in ``pretrain``."""
        return self.round if self.stage == "adapt" else -1

    @property
    def next_version(self) -> int:
        """Version of the weights after the fit: 0 after ``pretrain``, j + 1 after round j."""
        return self.policy_version + 1


VariationKey = tuple[str, int, int, int]
"""A variation's place in the dataset: stage, round, task, variation."""


class TrajectoryDataset(Protocol):
    """The trajectories collected so far."""

    def variations(self, stage: str, round: int) -> Sequence[VariationKey]:
        """The variations of one stage and round, in canonical order."""
        ...

    def trials(self, key: VariationKey) -> list[Trajectory]:
        """The trajectories of one variation, in order of trial."""
        ...


Draw = Callable[[np.random.Generator], Any]
"""Draws one training batch; the same generator state gives the same batch."""


class Weighted(Protocol):
    """Where a job finds the weights that it names."""

    def at(self, version: int) -> tuple[torch.nn.Module, str]:
        """The model of exactly this policy version, and its weights digest; waits until it is there."""
        ...


class Method(abc.ABC):
    """An in-context method: what it collects, what it learns from, its model, loss and deployed policy.

    One object serves one run; it may cache what it computed from the run's own data.
    """

    name: ClassVar[str]
    section: ClassVar[str] = ""
    """Name of its own section in a run file; empty if it has none."""
    Config: ClassVar[type | None] = None
    """Frozen dataclass of that section; every field has a default."""
    trains: ClassVar[bool] = True
    """Whether it trains a model that can be deployed."""
    shows_states: ClassVar[bool] = False
    """Whether its policy calls ``watch`` with the model's final states, from which the out-of-distribution score is read."""

    def objections(self, run: Run) -> Iterator[tuple[str, object, str]]:
        """What is impossible in a run of this method: the key, its value, the remedy."""
        yield from ()

    @abc.abstractmethod
    def phases(self, run: Run) -> tuple[Phase, ...]:
        """The phases of the run, in order."""

    @abc.abstractmethod
    def ask(self, run: Run, phase: Phase) -> tuple[Job, ...]:
        """The jobs of a phase."""

    @abc.abstractmethod
    def data(self, run: Run, phase: Phase, dataset: TrajectoryDataset) -> Draw:
        """What draws the training batches of a phase."""

    @abc.abstractmethod
    def build(self, spec: Spec, run: Run) -> torch.nn.Module:
        """An untrained model."""

    @abc.abstractmethod
    def loss(self, model: Any, batch: Any) -> torch.Tensor:
        """The loss of one batch, on the model's device."""

    @abc.abstractmethod
    def policy(
        self, model: Any, batch: int, context: ContextConfig, deploy: Deployment | None = None, watch: Watch | None = None
    ) -> Policy:
        """The model deployed in ``batch`` environments, its weights as they are now.

        ``deploy``: the deployment rule, or None for the one that the model was trained for.
        Raises ConfigError for a rule that it was not trained for.
        """

    @abc.abstractmethod
    def training_variations(self, run: Run, index: int, task: Task, round: int) -> tuple[Variation, ...]:
        """The variations of training task number ``index`` in a round."""

    def deployment(self, run: Run) -> Deployment:
        """The deployment rule that a model of this run was trained for."""
        return "paper"

    def distributions(
        self,
        model: Any,
        transitions: Sequence[np.ndarray],
        queries: Float32[np.ndarray, "B N S"],
        prefix: Int64[np.ndarray, "B N"],
    ) -> Float64[np.ndarray, "B N A"] | None:
        """Distributions over discrete actions at query states, each given its own prefix of the transitions.

        ``transitions``: observations (B, T, S), actions (B, T), next observations, rewards (B, T).  None for a
        method whose model cannot be queried so.
        """
        return None

    def label_quality(self, run: Run, phase: Phase, dataset: TrajectoryDataset) -> dict[str, float]:
        """How good the labels are that the model made itself in a phase; empty where it made none, or nobody can tell."""
        return {}
