"""Everything public that holds a state or arrays, each with one turn that uses it: for the contracts of this folder."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial
from typing import Any, NamedTuple

import numpy as np
import torch

import icrl_dist
from icrl_dist.agent.in_context_agent import InContextAgent
from icrl_dist.agent.trained_model import TrainedModel
from icrl_dist.config.run import load, make_run
from icrl_dist.config.sac import SACConfig
from icrl_dist.config.sections import ContextConfig, ModelConfig
from icrl_dist.experts.cache import History
from icrl_dist.experts.sac import batched
from icrl_dist.experts.train import ExpertPolicy, ScriptedPolicy
from icrl_dist.interfaces import Policy
from icrl_dist.methods import registry as methods
from icrl_dist.methods.examples import draw
from icrl_dist.models.dpt import PretrainedTransformer
from icrl_dist.models.weights import weights_of
from icrl_dist.problems import registry
from icrl_dist.problems.darkroom import room
from icrl_dist.problems.darkroom.behavior_policies import KINDS, Walks
from icrl_dist.problems.darkroom.exact_agents import RULES, ExactAgent, OptimalAgent
from icrl_dist.problems.darkroom.solver import Hypotheses, soft_labels
from icrl_dist.rollout.deployment import CommittedPolicy, InContextPolicy
from icrl_dist.rollout.policies import RandomPolicy, RandomVectorPolicy
from icrl_dist.training.batches import Pool
from icrl_dist.types import Adversary, Spec, Variation
from tests.contracts.game_battery import MakeVariation
from tests.problems.test_gym_adapter import ENVIRONMENTS, disturbed_room, noisy_pick_place, pushed
from tests.training.test_batches import examples

Call = Callable[..., Any]
"""``call(function, *arguments)`` calls the function and returns its result; a contract watches what crosses."""


class Subject(NamedTuple):
    name: str
    make: Callable[[], Any]
    turn: Callable[[Any, Call, int], object]
    """``turn(subject, call, number)``: uses it once, by ``call``; equal numbers give equal arguments."""


def leaves(value: Any) -> Iterator[np.ndarray]:
    """Every array in a result or an argument."""
    if isinstance(value, np.ndarray):
        yield value
    elif isinstance(value, torch.Tensor):
        yield value.detach().numpy()
    elif dataclasses.is_dataclass(value) and not isinstance(value, type):
        for item in dataclasses.fields(value):
            yield from leaves(getattr(value, item.name))
    elif isinstance(value, Mapping):
        for each in value.values():
            yield from leaves(each)
    elif isinstance(value, Sequence) and not isinstance(value, str):
        for each in value:
            yield from leaves(each)


def plain(value: Any) -> Any:
    """A result as values that are equal if their numbers are; arrays as their bytes."""
    if isinstance(value, np.ndarray):
        return value.dtype.str, value.shape, value.tobytes()
    if isinstance(value, Mapping):
        return {key: plain(each) for key, each in value.items()}
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return {item.name: plain(getattr(value, item.name)) for item in dataclasses.fields(value)}
    if isinstance(value, Sequence) and not isinstance(value, str):
        return [plain(each) for each in value]
    return value


def generators(turn: int, rows: int) -> list[np.random.Generator]:
    return [np.random.default_rng([turn, row]) for row in range(rows)]


def _actions(spec: Spec, turn: int, rows: int) -> np.ndarray:
    rng = np.random.default_rng(turn)
    if spec.discrete:
        return rng.integers(spec.actions, size=rows)
    return rng.uniform(-1, 1, (rows, spec.actions)).astype(np.float32)


def environment(make: MakeVariation) -> Subject:
    def turn(env: Any, call: Call, number: int) -> None:
        if number % 5 == 0:
            call(lambda: env.reset(seed=3) if number == 0 else env.reset())
        else:
            action = _actions(registry.spec(env.variation.task), number, 1)
            call(env.step, np.int64(action[0]) if action.ndim == 1 else action[0])

    return Subject(f"env-{make.__name__}", lambda: registry.make(make()), turn)


def batch_of(make: MakeVariation) -> Subject:
    def turn(env: Any, call: Call, number: int) -> None:
        if number % 5 == 0:
            call(env.reset, generators(number, env.batch))
        else:
            call(env.step, _actions(env.spec, number, env.batch))
            call(lambda: getattr(env, "truth", None))
            call(lambda: getattr(env, "success", None))

    return Subject(f"batch-{make.__name__}", lambda: registry.batch([make(), Variation(make().task)]), turn)


def transition(spec: Spec, turn: int, rows: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Observations of a room or of any other spec, rewards, and the next observations."""
    rng, low, high = np.random.default_rng(turn), np.array(spec.low), np.array(spec.high)
    obs, following = (rng.uniform(low, high, (rows, len(low))).astype(np.float32) for _ in range(2))
    if spec.discrete:  # a room: the agent stays where it is, which every hypothesis allows
        obs = following = np.rint(obs)
    return obs, np.zeros(rows, np.float32), following


ROWS = 2


def agent_of(name: str, make: Callable[[], InContextAgent]) -> Subject:
    def prepared() -> InContextAgent:
        agent = make()
        agent.reset_context(ROWS)
        return agent

    def turn(agent: InContextAgent, call: Call, number: int) -> None:
        obs, reward, following = transition(agent.spec, number, ROWS)
        action = np.array(call(agent.act, obs.copy()))
        if agent.spec.discrete:
            call(agent.distribution, obs.copy())
        call(agent.observe, obs, action, reward, following, np.full(ROWS, number % 4 == 3))
        call(agent.context, 1)
        if agent.outcomes is not None:
            call(lambda: agent.surprise)
            call(lambda: agent.outcomes.arrays() if agent.outcomes else None)
        call(lambda: agent.manifest)

    return Subject(f"agent-{name}", prepared, turn)


VECTORS = Spec((-1.0, -2.0), (1.0, 2.0), actions=2, horizon=4, discrete=False)
SPEC = Spec((0.0, 0.0), (3.0, 3.0), actions=5, horizon=4)
CONTEXT = ContextConfig(max=8)


def model(spec: Spec) -> PretrainedTransformer:
    torch.manual_seed(0)
    return PretrainedTransformer(spec, ModelConfig(layers=2, width=8, window=3)).eval()


def vector_agent() -> InContextAgent:
    run = make_run(context=CONTEXT, model=ModelConfig(layers=2, width=8, window=3))
    return InContextAgent(TrainedModel(run, methods.of(run), VECTORS, model(VECTORS)), {}, seed=0)


def policy_of(name: str, make: Callable[[], Policy], spec: Spec = SPEC) -> Subject:
    def turn(policy: Any, call: Call, number: int) -> None:
        obs, reward, following = transition(spec, number, ROWS)
        draws = np.random.default_rng(number).random((ROWS, 1 if spec.discrete else spec.actions))
        action = np.array(call(policy.act, obs.copy(), draws))
        if hasattr(policy, "probabilities") and spec.discrete:
            call(policy.probabilities, obs.copy())
        if isinstance(policy, ExactAgent):  # the action that keeps the agent where it is
            action[:] = 4
        call(policy.observe, obs, action, reward, following, number % 4 == 3)
        if hasattr(policy, "append"):
            columns = (following[:, None], action[:, None], following[:, None], reward[:, None])
            call(policy.append, *(column.copy() for column in columns))

    return Subject(f"policy-{name}", make, turn)


def deployed(kind: type[InContextPolicy], spec: Spec) -> InContextPolicy:
    return kind(model(spec), ROWS, CONTEXT)


def walk(kind: str) -> Walks:
    return Walks(4, 40, [kind] * ROWS, generators(0, ROWS))


def _goals() -> list[Variation]:
    return [Variation(room.task(divmod(cell, 4), 4, 4), Adversary.of("uniform", p=0.2)) for cell in range(16)]


def exact(rule: Any) -> ExactAgent:
    hypotheses = Hypotheses.of(_goals())
    labels = np.full((16, 16, 5), 0.2, np.float32)  # any action may be right, so that no action refutes a hypothesis
    return ExactAgent([hypotheses], [labels], np.zeros(ROWS, np.int64), rule)


def optimal() -> OptimalAgent:
    return OptimalAgent(soft_labels(Hypotheses.of(_goals()[:ROWS]), 0.99, 0.1), 4)


def expert() -> ExpertPolicy:
    config = SACConfig(hidden=(8,))
    batch = batched.SACBatch(range(ROWS), VECTORS, config, "cpu")
    shapes: dict[str, tuple[int, ...]] = dict.fromkeys(("observations", "window_observations"), (1, 3, 2))
    shapes |= dict.fromkeys(("rewards", "window_rewards"), (1, 2))
    names = [item.name for item in dataclasses.fields(History)][:-1]
    empty = {name: np.zeros(shapes.get(name, (1, 2, 2)), np.float32) for name in names}
    return ExpertPolicy([History(**empty, actor=actor) for actor in batch.arrays["actor"].numpy()], config)


def scripted() -> Any:
    env = registry.batch([noisy_pick_place()] * ROWS)
    env.reset(generators(0, ROWS))
    return ScriptedPolicy(registry.problem("metaworld-pick-place"), env)


def reads(name: str, make: Callable[[], Any], read: Callable[[Any], Any]) -> Subject:
    """A value that is only read."""
    return Subject(name, make, lambda subject, call, number: call(lambda: read(subject)))


def oracle_turn(hypotheses: Any, call: Call, number: int) -> None:
    oracle = icrl_dist.oracle
    for function in (oracle.optimal_values, oracle.optimal_returns, oracle.heuristic_labels):
        call(function, hypotheses)
    call(oracle.q_values, hypotheses, 0.9)
    call(oracle.soft_labels, hypotheses, 0.9, 0.1)


def sampler() -> Any:
    return draw(load("smoke"), [Pool(1.0, [examples(0, 3), examples(1, 3)], 2)])


SUBJECTS = [
    *map(environment, ENVIRONMENTS),
    *map(batch_of, (disturbed_room, noisy_pick_place, pushed("dmc-cheetah-run"), pushed("dmc-reacher-easy"))),
    agent_of("darkroom", lambda: icrl_dist.load_agent("darkroom", seed=0)),
    agent_of("darkroom-paper", lambda: icrl_dist.load_agent("darkroom", seed=0, deploy="paper")),
    agent_of("vectors", vector_agent),
    *(
        policy_of(f"{kind.__name__}-{name}", partial(deployed, kind, spec), spec)
        for kind in (InContextPolicy, CommittedPolicy)
        for name, spec in (("discrete", SPEC), ("vectors", VECTORS))
    ),
    *(policy_of(f"exact-{rule}", partial(exact, rule)) for rule in RULES),
    policy_of("optimal", optimal),
    policy_of("expert", expert, VECTORS),
    policy_of("random", lambda: RandomPolicy(5)),
    policy_of("random-vectors", RandomVectorPolicy, VECTORS),
    *(policy_of(f"walk-{kind}", partial(walk, kind)) for kind in KINDS),
    policy_of("scripted", scripted, registry.spec(noisy_pick_place().task)),
    reads("run", lambda: load("smoke"), lambda run: run),
    reads("run-dmc", lambda: load("dmc-cheetah-run"), lambda run: run),
    *(
        reads(f"problem-{name}", partial(registry.problem, name), lambda problem: problem.spec)
        for name in ("darkroom", "dmc-walker-run", "metaworld-pick-place")
    ),
    reads("exact-answers", lambda: registry.problem("darkroom").exact, lambda exact: exact.optimum([disturbed_room()])),
    reads("variation", disturbed_room, lambda variation: variation),
    reads("null", lambda: icrl_dist.NULL, lambda null: null),
    reads("identity", lambda: icrl_dist.Identity("adapt", 1, 2, 3, 4), lambda identity: identity.rng(3).random(4)),
    reads("interrupted", lambda: icrl_dist.TrainInterrupted("text", resumable=False), lambda e: (str(e), e.resumable)),
    reads("failed", lambda: icrl_dist.TrainFailed("text"), str),
    reads("weights", lambda: model(SPEC), weights_of),
    Subject("oracle", lambda: Hypotheses.of(_goals()), oracle_turn),
    Subject("sampler", sampler, lambda draw, call, number: call(draw, np.random.default_rng(number))),
]
