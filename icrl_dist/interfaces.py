"""The five interfaces of the system: ``Problem``, ``Method``, ``Policy``, ``Batch`` and ``Link``.

They refer to each other and are read together, so they stand in one file although it is longer than others.

The loop of a rollout worker (``actors/worker.py``)::

    run = ask("hello")
    problem, method = problems.of(run), methods.of(run)
    while (job := ask("lease")) is not None:
        for trajectory in collect.do(job, problem, method, weights):
            send(encode(trajectory))              # sent again until the learner has stored it

The loop of the central learner (``learner/service.py``)::

    for phase in method.phases(run):
        scheduler.open(method.ask(run, phase))    # workers lease these jobs
        while not scheduler.done(phase):          # ingest stores the trajectories that arrive
            wait()
        draw = method.data(run, phase, dataset)
        for step in range(phase.steps):
            method.loss(model, draw(rng(step))).backward()
            optimizer.step()
        publish(weights(model))                   # the policy version of the next round

All other code uses a problem or a method only through these interfaces.  Problems and methods, also those
of other packages, are found through the entry point groups ``icrl_dist.problems`` and ``icrl_dist.methods``.
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
from icrl_dist.types import NULL, Adversary, Identity, Job, Payload, Spec, Split, Step, Task, Trajectory, Variation

if TYPE_CHECKING:
    import torch

    from icrl_dist.config.run import Deployment, Run
    from icrl_dist.config.sections import AdversaryConfig, ContextConfig
    from icrl_dist.problems.benchmarks import Benchmarks
    from icrl_dist.problems.parts import Certificate, MakeGame, PosteriorSuite, SecondPlayer

__all__ = ["Batch", "EndsRun", "Link", "Method", "Policy", "Problem"]

Actions = Int64[np.ndarray, " B"] | Float32[np.ndarray, "B A"]
"""Actions in B environments: integers for discrete actions, else vectors in [-1, 1]."""

Progress = Callable[..., None]
"""``progress(text, note=False, reached=0)``: called repeatedly during long work.

``note``: show the text on a line of its own.  ``reached``: how far the work is.  If a worker crashes and
its repetition of the work gets further than before, the crash does not count as a failure of the job.
"""


def no_progress(text: str, note: bool = False, reached: int = 0) -> None:
    """A ``Progress`` that does nothing."""


class EndsRun(Exception):  # noqa: N818
    """Raised by a job: a person must decide before the run can go on, so it ends with this line instead of being repeated."""


class Batch(Protocol):
    """B variation environments stepped together; each row draws from its own generator."""

    spec: Spec
    batch: int

    def reset(self, rngs: Sequence[np.random.Generator]) -> Float[np.ndarray, "B S"]:
        """Start an episode in every row."""
        ...

    def step(self, actions: Int[np.ndarray, " B"] | Float32[np.ndarray, "B A"]) -> Step:
        """Execute one action in every row.  Raises RuntimeError past the horizon."""
        ...


class Policy(Protocol):
    """Acts in B environments at once; ``observe`` is its only source of information about them."""

    def act(self, observation: Float32[np.ndarray, "B S"], u: Float[np.ndarray, "B U"]) -> Actions:
        """Actions sampled with the uniform numbers ``u`` in [0, 1): one number per row, or one per component."""
        ...

    def observe(
        self,
        observation: Float32[np.ndarray, "B S"],
        action: Actions,
        reward: Float32[np.ndarray, " B"],
        next_observation: Float32[np.ndarray, "B S"],
        done: bool,
    ) -> None:
        """Receive one transition of every environment."""
        ...


MakePolicy = Callable[[Sequence[Variation], Batch], Policy]
"""``make(variations, batch)``: a policy that acts in this batch, whose rows are these variations."""

Watch = Callable[..., object]
"""Called after every decision of an in-context policy with the decision and its outcome.

Arguments: the model's final hidden state (B, D), observation, action, reward, next observation.
"""


class LabelledQueries(NamedTuple):
    """Query states of one trajectory with their labels, and action windows (zeta_h of eq. 6)."""

    queries: Float32[np.ndarray, "Q S"]
    labels: Float32[np.ndarray, "Q A"]
    prev_actions: Int16[np.ndarray, " R"] | Float32[np.ndarray, "R A"]
    """Actions at the last R query states, which form action windows."""
    prev_rewards: Float32[np.ndarray, " R"]
    """Reward after each of these actions."""
    origin: str
    """Source of the labels: see ``Trajectory.origin``."""


Labeller = Callable[[Sequence[Identity], Sequence[np.random.Generator]], list[LabelledQueries]]
"""``labeller(identities, rngs)``: query states of each trajectory, drawn with its own generator, and their labels."""


@dataclass(frozen=True)
class Contexts:
    """How a problem collects the contexts of the pretraining dataset."""

    payload: Payload
    """Payload of the collecting jobs."""
    most_trials: int | None = None
    """Maximum number of episodes per variation; None for no limit."""


@dataclass(frozen=True)
class LearningHistories:
    """How a problem records histories of a learning agent: the episodes of a variation, in the order in which it learned."""

    payload: Payload
    """Payload of the recording jobs."""
    trials: int
    """Episodes of each variation."""
    count: int = 1
    """Histories of each variation, one after another; each begins with an untrained agent.

    History h holds the trials from ``trials * h // count`` to before ``trials * (h + 1) // count``.
    """


@dataclass(frozen=True)
class Reference:
    """An agent that tables compare the models with."""

    make: MakePolicy
    ceiling: bool = False
    """Whether it is given the task: tables then also show returns as a share of this agent's return."""


JobFunction = Callable[[Job, "Problem", str, Progress], Iterator[Trajectory]]
"""``do(job, problem, worker, progress)``: does a job and yields each trajectory when its episode ends."""


class JobKind(NamedTuple):
    """A kind of job that needs no model: the type of its payload, and the function that does it."""

    payload: type[Payload]
    do: JobFunction


class ExactAnswers(Protocol):
    """Exact solutions of variations, for problems that can be solved."""

    def optimum(self, variations: Sequence[Variation]) -> Float64[np.ndarray, " M"]:
        """Expected undiscounted return of the optimal policy from the start of a test episode."""
        ...

    def optimal(
        self, variation: Variation, states: Float32[np.ndarray, "Q S"], labels: Float32[np.ndarray, "Q A"]
    ) -> Float[np.ndarray, " Q"]:
        """1 where the most probable action of a label is optimal at its state, else 0."""
        ...

    def agent(self, run: Run, rule: str) -> MakePolicy:
        """The exact agent: posterior sampling (Theorem E.3) without a network, deployed by this rule."""
        ...


class BeliefReader(Protocol):
    """Computes the belief about the task of one variation that an in-context policy's action distributions imply."""

    def message(self, policy: Any, row: int) -> dict[str, Any]:
        """Fields of a ``belief`` message of the monitor plane (docs/tap.md) for environment ``row`` of the policy."""
        ...


@dataclass(frozen=True)
class Behaviors:
    """Policies that collect pretraining contexts and are not given the task."""

    names: tuple[str, ...]
    """The names that ``pretrain.behaviors`` may hold."""
    make: Callable[[Sequence[str], Sequence[np.random.Generator], Batch], Policy]
    """``make(names, rngs, env)``: row r follows the policy ``names[r]``, which draws from ``rngs[r]``."""


@dataclass(frozen=True)
class Limits:
    """What values the trajectories of a problem can have, beyond its spec; others are refused."""

    reward: tuple[float, float] = (-1e6, 1e6)
    """Smallest and largest reward of a step."""
    slack: float = 0.0
    """By how many times its range an observation component may exceed that range, on either side."""
    disturbances: int | None = None
    """Components of an adversary's action, with vector actions; None: any number."""

    def disturbance(self, adversary: Adversary) -> float:
        """Largest component of this adversary's action, with vector actions: its ``strength`` if it has one."""
        if adversary == NULL:
            return 0.0
        return adversary.number("strength") * (1 + 1e-6) if "strength" in dict(adversary.params) else 1e6


MakeDrawing = Callable[[np.ndarray, np.ndarray, Mapping[str, Any], int], dict[str, Any]]
"""See ``Problem.drawing``."""


class Problem(abc.ABC):
    """A family of tasks with its adversaries, made from one section of a run file.

    It defines the split into training and test tasks, the environments, the adversaries, the source of
    labels, and the reference agents.  An optional part that a problem lacks is None: callers check for
    the part, never for the name of the problem.
    """

    section: ClassVar[str]
    """Name of its section in a run file."""
    Config: ClassVar[type]
    """Frozen dataclass of that section; every field has a default."""
    Labelling: ClassVar[type]
    """Frozen dataclass of the settings by which a job labels query states; see ``labelling``.

    With a field ``undisturbed: bool = False`` the method ``dr`` can be used: if it is true, the labels of every variation
    are those of its task under the null adversary."""
    template: ClassVar[str] = ""
    """Packaged run file that problems of this class share, if any: ``dmc`` for ``dmc.toml`` and ``dmc-laptop.toml``."""
    free_in_forks: ClassVar[tuple[str, ...]] = ()
    """Fields of the section that a fork may change, because neither the tasks nor their split depend on them."""
    libraries: ClassVar[tuple[str, ...]] = ()
    """Distributions, beside numpy, whose versions decide the bytes of the environments' episodes, as in ``("mujoco",)``.
    A cached expert is used with the same versions only."""
    job_kinds: ClassVar[Mapping[str, JobKind]] = {}
    """Kinds of jobs that only this problem has."""
    agent_names: ClassVar[Mapping[str, str]] = {}
    """What tables call reference agents, by the agents' keys; an agent that is missing here is called by its key."""
    earns_in_contexts: ClassVar[bool] = True
    """Whether episodes of pretraining contexts should have returns above 0; if False, returns of 0 raise no alert."""

    def __init__(self, name: str, config: Any) -> None:
        """``name``: as in a run file; ``config``: the section of the run file, an instance of ``Config``."""
        self.name, self.config = name, config

    @abc.abstractmethod
    def spec_of(self, task: Task) -> Spec:
        """Spec of a task's observations and actions.  Raises ValueError for an impossible task."""

    @abc.abstractmethod
    def make_split(self) -> Split:
        """Compute the training and test tasks, only from the section; use ``split``, which keeps the result."""

    @abc.abstractmethod
    def batch(self, variations: Sequence[Variation]) -> Batch:
        """These variation environments as one batch.

        What decides an environment belongs in the parameters of its task and adversary: ``icrl_dist.make``, live
        views and the cache of experts know only these.
        """

    @abc.abstractmethod
    def training_adversaries(self, rng: np.random.Generator, config: AdversaryConfig) -> tuple[Adversary, ...]:
        """The K disturbances of one training task, without phi_0 (section 4.1): ``config.count`` of them, all different.

        The first ones do not depend on K: with the same generator a larger K adds adversaries at the end.
        """

    @abc.abstractmethod
    def test_adversary(self, rng: np.random.Generator, strength: float, prior: str) -> Adversary:
        """An adversary for tests, not among those of training.

        ``strength``: a number above 0 from ``evaluate.p``; ``prior``: ``evaluate.prior``.  It is called once for every
        evaluation of a task, each time with a generator of its own.
        """

    @abc.abstractmethod
    def labelling(self, run: Run) -> Any:
        """The settings by which this run's jobs label query states: an instance of ``Labelling``."""

    @abc.abstractmethod
    def contexts(self, run: Run) -> Contexts:
        """How pretraining contexts are collected."""

    @abc.abstractmethod
    def references(self, run: Run) -> dict[str, Reference]:
        """The reference agents by key, in the tables' order.

        Result rows hold the keys (docs/data.md), so a key never changes; ``agent_names`` holds the names that tables
        show.  ``random`` is the random policy, ``expert`` a policy trained in the task.
        """

    # Optional parts: a problem that has a part overrides the property.

    @property
    def exact(self) -> ExactAnswers | None:
        """Exact solutions of variations."""
        return None

    @property
    def labeller(self) -> Callable[[Job, Any], Labeller] | None:
        """``labeller(job, labelling)``: a labeller for new trajectories of the job's variations."""
        return None

    def learning_histories(self, run: Run, trials: int) -> LearningHistories | None:
        """Histories of a learning agent, of at most ``trials`` episodes in each variation, for Algorithm Distillation."""
        return None

    def robust_contexts(self, run: Run) -> Contexts | None:
        """``contexts`` with labels of the robust policy pi^rb of each task (eq. 4); None if the problem has no such policies.

        Raises ConfigError, with the key and the remedy, if it has none with these settings.
        """
        return None

    @property
    def behaviors(self) -> Behaviors | None:
        """Behavior policies, which jobs of the kind ``behavior_context`` need."""
        return None

    @property
    def scripted(self) -> Callable[[Float[np.ndarray, "N T"]], Float32[np.ndarray, "N A"]] | None:
        """``scripted(truth)``: a hand-written policy of the true states, which the batch's attribute ``truth`` holds."""
        return None

    @property
    def belief(self) -> Callable[[Variation], BeliefReader] | None:
        """``belief(variation)``: computes an in-context policy's belief about the task, for live views."""
        return None

    @property
    def drawing(self) -> MakeDrawing | None:
        """``drawing(states, adversary, task, every)``: an episode as numbers that live views draw (docs/tap.md).

        ``states``: every ``every``-th observation; ``adversary``: the adversary's action or strength at each of
        them; ``task``: the task's parameters.  Raises ValueError for an episode that cannot be drawn.
        """
        return None

    @property
    def message_optimum(self) -> Callable[[Mapping[str, Any], Mapping[str, Any]], float | None] | None:
        """``message_optimum(task, adversary)``: optimal return of the variation that a monitor message describes."""
        return None

    @property
    def posterior(self) -> PosteriorSuite | None:
        """Comparison of a model with the exact posterior (``icrl-dist evaluate --suite posterior``)."""
        return None

    @property
    def certify(self) -> Certificate | None:
        """Exact returns of policies that are fixed within an episode, also against the worst adversary of a strength p."""
        return None

    @property
    def second_player(self) -> SecondPlayer | None:
        """The adversary as a player that can be trained against a policy, or together with one (RARL, QARL)."""
        return None

    @property
    def game(self) -> MakeGame | None:
        """``game(agent, run, seed)``: the interactive environment of ``icrl-dist play``."""
        return None

    @property
    def benchmarks(self) -> Benchmarks | None:
        """What ``icrl-dist bench`` needs of the problem; None for a problem that no benchmark measures."""
        return None

    @functools.cached_property
    def split(self) -> Split:
        """The training tasks and the test tasks."""
        return self.make_split()

    @functools.cached_property
    def spec(self) -> Spec:
        """The spec that all of the problem's tasks share."""
        return self.spec_of(self.split.train[0])

    @property
    def limits(self) -> Limits:
        """The values that its trajectories can have."""
        return Limits()

    @property
    def horizon(self) -> int:
        """Steps per episode, H."""
        return self.spec.horizon

    @property
    def train_count(self) -> int:
        """Number of training tasks."""
        return len(self.split.train)

    @property
    def evaluated(self) -> tuple[Task, ...]:
        """The tasks of online evaluation; by default the test tasks."""
        return self.split.test

    @property
    def evaluated_count(self) -> int:
        """Number of tasks of online evaluation."""
        return len(self.evaluated)

    def at_test_start(self, task: Task) -> Task:
        """The task with the initial state of test episodes."""
        return task

    def resolved(self) -> Any:
        """The section with the numbers of its symbolic values (such as ``drop:0.25``) stored beside them.

        So a table that changes later does not change the run.  Raises ConfigError for a value that cannot be resolved.
        """
        return self.config

    @classmethod
    def translated(cls, tables: dict[str, Any]) -> dict[str, Any]:
        """The tables of a run file that an older version wrote, with the problem's former values translated.

        The names of sections and keys are the present ones already; sections of other problems are still there.
        """
        return tables

    def objections(self, run: Run) -> Iterator[tuple[str, object, str]]:
        """The values that a run of this problem cannot have: key, value, remedy."""
        yield from ()

    def missing_reference(self, run: Run, what: str) -> str:
        """Why a reference agent is missing from the tables, and the remedy; empty if none is missing.

        ``what``: the run that the remedy's command names.
        """
        return ""

    def title(self, tasks: int) -> str:
        """Description of the evaluated tasks for titles: ``20 held-out goals of a 10x10 Dark Room``."""
        return f"{tasks} held-out tasks of {self.name}"

    def manifest(self) -> dict[str, Any]:
        """Entries of a checkpoint's manifest about the problem and its split, as JSON values."""
        train, test = ([dict(task.params) for task in part] for part in (self.split.train, self.split.test))
        return {"train_tasks": train, "test_tasks": test}


@dataclass(frozen=True)
class Phase:
    """One pass through the learner's loop: collect, then fit."""

    stage: str
    round: int
    steps: int
    """Optimizer steps of the fit."""
    learning_rate: float
    """Peak learning rate of the fit."""

    @property
    def policy_version(self) -> int:
        """Version of the weights that collect: j in round j of ``adapt``; -1, no weights, in ``pretrain``."""
        return self.round if self.stage == "adapt" else -1

    @property
    def next_version(self) -> int:
        """Version of the weights after the fit: 0 after ``pretrain``, j + 1 after round j."""
        return self.policy_version + 1


VariationKey = tuple[str, int, int, int]
"""A variation's place in the dataset: stage, round, task, variation."""


class TrajectoryDataset(Protocol):
    """The trajectories that a run has collected so far."""

    def variations(self, stage: str, round: int) -> Sequence[VariationKey]:
        """The variations of one stage and round, in canonical order."""
        ...

    def trials(self, key: VariationKey) -> list[Trajectory]:
        """The trajectories of one variation, ordered by trial."""
        ...


class RatedVariation(NamedTuple):
    """Trials of the model in one training variation, and how good the labels are that it made from them."""

    trials: Sequence[Trajectory]
    """In the order of ``Identity.trial``."""
    optimum: float
    """Expected return of the optimal policy."""
    agreement: float | None
    """Share of the labels that are optimal; None if the trials gave no labels."""
    context_trials: int
    """The first so many trials became contexts; labels come from later ones."""


Draw = Callable[[np.random.Generator], Any]
"""Draws one training batch; the same generator state gives the same batch."""


class WeightSource(Protocol):
    """Gives the model of a policy version, for example from a worker's weight cache."""

    def at(self, version: int) -> tuple[torch.nn.Module, str]:
        """The model of exactly this policy version, and its weights digest.  Blocks until it is available."""
        ...


@dataclass(frozen=True)
class LabelQuality:
    """Quality of the labels that a model made itself in one round.  Returns are undiscounted, per episode."""

    agreement: float
    """Share of the labels that are optimal, 0 to 1."""
    labelling: float
    """Share of the variations whose trials gave labels, 0 to 1."""
    context_return: float
    """Mean return of the trials that became contexts."""
    label_return: float
    """Mean return of the later trials, which labels come from."""
    optimum: float
    """Mean optimal return of the variations."""


class UsedLabels(NamedTuple):
    """The labels of a job that a method learns from."""

    source: str
    """``optimal``, ``heuristic`` or ``expert`` as ``Trajectory.origin``; ``own actions``, ``own returns`` or
    ``own transitions`` of the model, as ``icaa.labels``; ``logged actions`` of the behavior policies, ``learner's actions``
    of a learning agent; ``none`` without labels."""
    trials: int
    """Trials of each variation whose labels are used; at most so many where it depends on returns."""


class Method(abc.ABC):
    """An in-context method: its phases and jobs, its training batches, model, loss and deployed policy.

    An object may cache what it computed from the data of its run: the learner makes a new object after a repair of
    the dataset, so no cached result is older than the data.
    """

    name: ClassVar[str]
    section: ClassVar[str] = ""
    """Name of its section in a run file; empty if it has none."""
    Config: ClassVar[type | None] = None
    """Frozen dataclass of that section; every field has a default."""
    trains: ClassVar[bool] = True
    """Whether it trains a model that can be deployed."""
    product: ClassVar[str] = "expert"
    """If it trains no model: the key, in result rows, of the policies that it trains."""
    shows_states: ClassVar[bool] = False
    """Whether its policy calls ``watch`` with the model's final hidden states, which the OOD score is computed from."""

    @property
    def fits_by_kernel(self) -> bool:
        """Whether model and loss are DPT's, so that the compiled kernel can fit it (``learner.reproducible``)."""
        return False

    def objections(self, run: Run) -> Iterator[tuple[str, object, str]]:
        """The values that a run of this method cannot have: key, value, remedy."""
        yield from ()

    @abc.abstractmethod
    def phases(self, run: Run) -> tuple[Phase, ...]:
        """The phases of the run, in order."""

    def extra_steps(self, run: Run) -> int:
        """Optimizer steps of other nets than the in-context model, beside those of the phases."""
        return 0

    @abc.abstractmethod
    def ask(self, run: Run, phase: Phase) -> tuple[Job, ...]:
        """The jobs that collect the data of a phase."""

    @abc.abstractmethod
    def data(self, run: Run, phase: Phase, dataset: TrajectoryDataset) -> Draw:
        """A function that draws the training batches of a phase."""

    @abc.abstractmethod
    def build(self, spec: Spec, run: Run) -> torch.nn.Module:
        """An untrained model."""

    @abc.abstractmethod
    def loss(self, model: Any, batch: Any) -> torch.Tensor:
        """The loss of one training batch, on the model's device."""

    @abc.abstractmethod
    def policy(
        self, model: Any, batch: int, context: ContextConfig, deploy: Deployment | None = None, watch: Watch | None = None
    ) -> Policy:
        """The model deployed in ``batch`` environments, with its present weights.

        ``deploy``: the deployment rule; None for the rule that the model was trained for.
        Raises ConfigError for a rule that the model was not trained for.
        """

    @abc.abstractmethod
    def training_variations(self, run: Run, index: int, task: Task, round: int) -> tuple[Variation, ...]:
        """The variations of training task ``task``, whose number is ``index``, in a round."""

    def stored_model(self, spec: Spec, run: Run, weights: Mapping[str, np.ndarray]) -> Any | None:
        """The trained model of a checkpoint as ``policy`` takes it where the compiled decoder decides, without torch.

        ``weights``: by their names in ``state_dict``.  None: the method has none, and ``policy`` is given the model that
        ``build`` makes.  Raises ValueError if the weights do not fit it.
        """
        return None

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
        """Distributions over discrete actions at query states, each conditioned on its own prefix of the transitions.

        ``transitions``: observations (B, T, S), actions (B, T), next observations (B, T, S), rewards (B, T);
        ``prefix``: number of transitions that each query is conditioned on.  Returns None if the method's model
        does not support such queries.
        """
        return None

    def used_labels(self, run: Run, phase: Phase, job: Job) -> UsedLabels | None:
        """The labels of a job that the fits use; by default those that its payload asks for, None if it does not say.

        A method that makes labels itself, or uses only some, overrides this; ``methods.budget`` counts with it.
        """
        counts = job.payload.labels
        return counts and UsedLabels(counts.origin, job.trials if counts.queries else 0)

    def label_quality(self, run: Run, phase: Phase, dataset: TrajectoryDataset) -> Iterator[RatedVariation]:
        """The variations that the model labelled itself in a phase; none if it labelled none or quality is unknown."""
        yield from ()
