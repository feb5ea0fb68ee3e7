"""Dark Room as a ``Problem``: exact labels, exact agents, and adversaries of three families."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
from jaxtyping import Float, Float32, Float64

from icrl_dist.collect.behavior import BehaviorContexts
from icrl_dist.config.q_learning import QLearning
from icrl_dist.config.random_keys import RandomKey, generator
from icrl_dist.config.sections import AdversaryConfig
from icrl_dist.config.toml import ConfigError
from icrl_dist.interfaces import (
    Batch,
    Behaviors,
    BeliefReader,
    Contexts,
    JobKind,
    Labeller,
    LearningHistories,
    Limits,
    MakeDrawing,
    MakePolicy,
    Policy,
    Problem,
    Reference,
)
from icrl_dist.problems.darkroom import picture, room
from icrl_dist.problems.darkroom.adversaries import adversary_set, sample
from icrl_dist.problems.darkroom.behavior_policies import KINDS, Walks
from icrl_dist.problems.darkroom.certificate import RoomCertificate
from icrl_dist.problems.darkroom.config import DarkRoomConfig
from icrl_dist.problems.darkroom.exact_agents import KEYS, RULES, ExactAgent, OptimalAgent, Rule
from icrl_dist.problems.darkroom.labels import RoomLabeller, RoomLabelling
from icrl_dist.problems.darkroom.prior_agents import Prior, PriorAgent, PriorRule, dpt_prior, icag_prior, prior_agents
from icrl_dist.problems.darkroom.q_learning import QLearningHistories, q_learning
from icrl_dist.problems.darkroom.solver import Hypotheses, cell_numbers, optimal_returns, soft_labels
from icrl_dist.rollout.policies import RandomPolicy
from icrl_dist.types import Adversary, Job, Spec, Split, Task, Variation

if TYPE_CHECKING:
    from icrl_dist.config.run import Run
    from icrl_dist.problems.benchmarks import Benchmarks
    from icrl_dist.problems.parts import MakeGame, PosteriorSuite

ORACLE = "oracle"
"""Key of the optimal policy of each variation."""


class ExactRoom:
    """Exact solutions of variations of rooms with this section of a run file."""

    def __init__(self, config: DarkRoomConfig) -> None:
        self._config = config
        self._by_adversary: dict[Adversary, tuple[Hypotheses, Float32[np.ndarray, "M C A"]]] = {}
        self._priors: dict[AdversaryConfig | None, Prior] = {}

    def optimum(self, variations: Sequence[Variation]) -> Float64[np.ndarray, " M"]:
        """Expected return of the optimal policy from the origin, by value iteration."""
        return optimal_returns(Hypotheses.of(variations))

    def optimal(
        self, variation: Variation, states: Float32[np.ndarray, "Q 2"], labels: Float32[np.ndarray, "Q A"]
    ) -> Float[np.ndarray, " Q"]:
        """1 where the most probable action of a label is among the optimal ones, else 0."""
        hypotheses = Hypotheses.of([variation])
        best = soft_labels(hypotheses, self._config.gamma, self._config.label_slack)[0]
        good: Float[np.ndarray, " Q"] = (best[cell_numbers(states, hypotheses.size), labels.argmax(axis=1)] > 0).astype(float)
        return good

    def agent(self, run: Run, rule: str) -> MakePolicy:
        """The exact agent, which is given every row's adversary; its prior over goals is uniform over all cells."""

        def make(rows: Sequence[Variation], env: Batch) -> ExactAgent:
            adversaries = list(dict.fromkeys(v.adversary for v in rows))
            families, labels = zip(*(self._any_goal(a) for a in adversaries), strict=True)
            chosen: Rule = rule  # type: ignore[assignment]
            return ExactAgent(families, labels, np.array([adversaries.index(v.adversary) for v in rows]), chosen)

        return make

    def prior_agent(self, adversary: AdversaryConfig | None, rule: PriorRule) -> MakePolicy:
        """The exact agent with ICAG's prior, given the adversaries of training; None: with DPT's prior."""

        def make(rows: Sequence[Variation], env: Batch) -> PriorAgent:
            if adversary not in self._priors:
                found = dpt_prior(self._config) if adversary is None else icag_prior(self._config, adversary)
                self._priors[adversary] = found
            return PriorAgent(self._priors[adversary], len(rows), rule)

        return make

    def _any_goal(self, adversary: Adversary) -> tuple[Hypotheses, Float32[np.ndarray, "M C A"]]:
        """One hypothesis per goal under this adversary, with their labels; cached for the latest 256 adversaries."""
        if adversary not in self._by_adversary:
            size, horizon = self._config.size, self._config.horizon
            goals = [room.task(divmod(cell, size), size, horizon) for cell in range(size**2)]
            hypotheses = Hypotheses.of([Variation(goal, adversary) for goal in goals])
            self._by_adversary[adversary] = hypotheses, soft_labels(hypotheses, self._config.gamma, self._config.label_slack)
            if len(self._by_adversary) > 256:
                del self._by_adversary[next(iter(self._by_adversary))]
        return self._by_adversary[adversary]


class DarkRoomProblem(Problem):
    """A hidden goal in a square room (appendix C.1)."""

    section = "darkroom"
    Config = DarkRoomConfig
    Labelling = RoomLabelling
    agent_names: ClassVar[Mapping[str, str]] = {KEYS[rule]: name for rule, name in RULES.items()} | {
        key: name for key, name, _, _ in prior_agents()
    }
    job_kinds: ClassVar[Mapping[str, JobKind]] = {QLearningHistories.kind: JobKind(QLearningHistories, q_learning)}
    earns_in_contexts: ClassVar[bool] = False  # a random walk may miss the goal in every episode
    config: DarkRoomConfig

    def spec_of(self, task: Task) -> Spec:
        return room.spec(task)

    @property
    def limits(self) -> Limits:
        return Limits(reward=(0.0, 1.0))

    @property
    def horizon(self) -> int:
        return self.config.horizon

    @property
    def train_count(self) -> int:
        return round(self.config.train_fraction * self.config.size**2)

    @property
    def evaluated_count(self) -> int:
        return self.config.size**2 - self.train_count

    def make_split(self) -> Split:
        """All goals, shuffled with ``split_seed``; the first ``train_fraction`` of them are training tasks."""
        of = self.config
        goals = [(x, y) for x in range(of.size) for y in range(of.size)]
        order = generator(of.split_seed, RandomKey.SPLIT).permutation(len(goals))
        tasks = [room.task(goals[i], of.size, of.horizon) for i in order]
        return Split(tuple(tasks[: self.train_count]), tuple(tasks[self.train_count :]))

    def batch(self, variations: Sequence[Variation]) -> Batch:
        return room.DarkRoom(variations)

    def at_test_start(self, task: Task) -> Task:
        """Test episodes start in the origin (appendix C.1)."""
        return task.replace(start=(0, 0))

    def training_adversaries(self, rng: np.random.Generator, config: AdversaryConfig) -> tuple[Adversary, ...]:
        return adversary_set(rng, config.count, room.ACTIONS, config.p_max, self.config.disturbance, config.p_min)

    def test_adversary(self, rng: np.random.Generator, strength: float, prior: str) -> Adversary:
        """``uniform``: q_b = 1/5 (Figures 3c, 6c); ``unseen``: a newly drawn Dirichlet adversary (Figures 3d, 6d).

        The priors are the same for winds and permuted controls: any direction, or any permutation, equally likely.
        """
        if self.config.disturbance == "override" and prior == "uniform":
            return Adversary.of("uniform", p=strength)
        return sample(rng, self.config.disturbance, room.ACTIONS, 1.0).replace(p=strength)

    def labelling(self, run: Run) -> RoomLabelling:
        of, windows = self.config, run.pretrain.windows
        goals = (task.vector("goal") for task in self.split.train)
        decoys = tuple(int(x) * of.size + int(y) for x, y in goals) if windows else ()
        return RoomLabelling(
            labels=of.labels,
            gamma=of.gamma,
            slack=of.label_slack,
            queries=run.pretrain.queries,
            window=run.model.window,
            windows=windows,
            decoy_fraction=run.pretrain.decoy_fraction,
            decoys=decoys,
        )

    def contexts(self, run: Run) -> Contexts:
        return Contexts(BehaviorContexts(run.pretrain.behaviors, self.labelling(run)))

    def robust_contexts(self, run: Run) -> Contexts:
        """The contexts of ``contexts``, labelled by the exact max-min policy against overrides of ``adversary.p_max``."""
        of = self.config
        if of.disturbance != "override":
            raise ConfigError(
                f"darkroom.disturbance = {of.disturbance!r}: robust policies are known for 'override' only: use it"
            )
        if of.labels == "heuristic":
            raise ConfigError("darkroom.labels = 'heuristic': robust policies are exact: use 'soft' or 'sampled'")
        labelling = dataclasses.replace(self.labelling(run), worst_p=run.adversary.p_max)
        return Contexts(BehaviorContexts(run.pretrain.behaviors, labelling))

    def learning_histories(self, run: Run, trials: int) -> LearningHistories:
        """Histories of tabular Q-learning, of ``ad.history_episodes`` episodes or more, so that no episode is left over."""
        of = run.section("ad")
        count = max(1, trials // of.history_episodes)
        return LearningHistories(QLearningHistories(QLearning.of(of), count), trials, count)

    def references(self, run: Run) -> dict[str, Reference]:
        """A random policy, exact agents, and the oracle, which is given goal and adversary.

        The exact agent of each rule is given the adversary; the agents of ``prior_agents`` are given a prior.
        """

        def random(rows: Sequence[Variation], env: Batch) -> Policy:
            return RandomPolicy(room.ACTIONS)

        def optimal(rows: Sequence[Variation], env: Batch) -> Policy:
            hypotheses = Hypotheses.of(rows)
            return OptimalAgent(soft_labels(hypotheses, self.config.gamma, slack=0.0), hypotheses.size)

        exact = {KEYS[rule]: Reference(self.exact.agent(run, rule)) for rule in RULES}
        priors = {
            key: Reference(self.exact.prior_agent(None if prior == "dpt" else run.adversary, rule))
            for key, _, prior, rule in prior_agents()
        }
        return {"random": Reference(random), **exact, **priors, ORACLE: Reference(optimal, ceiling=True)}

    def objections(self, run: Run) -> Iterator[tuple[str, object, str]]:
        of = self.config
        if not 0 < self.train_count < of.size**2:
            yield "darkroom.train_fraction", of.train_fraction, "leave at least one goal to train on and one to test on"

    def title(self, tasks: int) -> str:
        return f"{tasks} held-out goals of a {self.config.size}x{self.config.size} Dark Room"

    def manifest(self) -> dict[str, Any]:
        goals = [[int(c) for c in task.vector("goal")] for task in self.split.test]
        return {"split_seed": self.config.split_seed, "size": self.config.size, "test_goals": goals}

    @functools.cached_property
    def exact(self) -> ExactRoom:
        return ExactRoom(self.config)

    @property
    def labeller(self) -> Callable[[Job, RoomLabelling], Labeller]:
        return RoomLabeller

    @property
    def behaviors(self) -> Behaviors:
        """Walks through the room: one behavior policy per row."""

        def walks(names: Sequence[str], rngs: Sequence[np.random.Generator], env: Batch) -> Policy:
            return Walks(round(env.spec.high[0]) + 1, env.spec.horizon, names, rngs)

        return Behaviors(KINDS, walks)

    @property
    def belief(self) -> Callable[[Variation], BeliefReader]:
        from icrl_dist.problems.darkroom.posterior import RoomBelief

        return functools.partial(RoomBelief, self.config)

    @property
    def drawing(self) -> MakeDrawing:
        return picture.drawing

    @property
    def message_optimum(self) -> Callable[[Mapping[str, Any], Mapping[str, Any]], float | None]:
        return picture.message_optimum

    @property
    def posterior(self) -> PosteriorSuite:
        """The comparison with the exact posterior."""
        from icrl_dist.problems.darkroom.divergence import RoomPosteriorSuite

        return RoomPosteriorSuite(self.config)

    @property
    def certify(self) -> RoomCertificate | None:
        """Only for overrides: the worst override adversary says nothing about winds and permuted controls."""
        return RoomCertificate(self.config.size) if self.config.disturbance == "override" else None

    @property
    def game(self) -> MakeGame:
        """The interactive room of ``icrl-dist play``."""
        from icrl_dist.problems.darkroom.game import PlayGame

        return PlayGame

    @property
    def benchmarks(self) -> Benchmarks:
        from icrl_dist.problems.darkroom import bench

        return bench.benchmarks()
