"""Divergence of a model from the exact posterior: against slow loops, in a 3x3 room with two adversaries."""

from __future__ import annotations

import dataclasses
import functools
import itertools
import math
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import numpy as np
import pytest
import torch

from icrl_dist.agent.trained_model import TrainedModel
from icrl_dist.config.run import Run, override
from icrl_dist.config.sections import AdversaryConfig
from icrl_dist.interfaces import Batch
from icrl_dist.methods import registry as methods
from icrl_dist.models.dpt import PretrainedTransformer, Transitions
from icrl_dist.problems import registry
from icrl_dist.problems.darkroom import divergence
from icrl_dist.problems.darkroom.adversaries import argmax_distribution
from icrl_dist.problems.darkroom.divergence import KINDS, PRIORS, Divergence, RoomContext
from icrl_dist.problems.darkroom.room import ACTIONS
from icrl_dist.problems.darkroom.solver import Hypotheses, cell_numbers, heuristic_labels, soft_labels
from icrl_dist.results import evaluate
from icrl_dist.rollout.policies import RandomPolicy
from icrl_dist.types import NULL, Adversary, Variation
from tests.calls import keeping, noting
from tests.jobs import in_problem
from tests.optional import known
from tests.problems.darkroom.test_exact_agents import Transition, likelihood
from tests.problems.darkroom.test_solver import ADVERSARIES, ALPHA, HORIZON, SIZE, Room, every_cell, normalized, slow_q

GAMMA, SLACK = 0.99, 0.1
OTHERS = (NULL, Adversary.of("dirichlet", p=0.2, alpha=ALPHA[::-1]))


@pytest.fixture
def run(small_run: Run) -> Run:
    """ICAG with two adversaries a goal: 7 goals to train on, 2 held out."""
    return dataclasses.replace(small_run, method="icag", adversary=AdversaryConfig(count=1))


@pytest.fixture
def model(run: Run) -> PretrainedTransformer:
    torch.manual_seed(0)
    return PretrainedTransformer(registry.of(run).spec, run.model).eval()


def own(room: Room) -> list[Variation]:
    """Every goal with two adversaries, which are not the next goal's."""
    return [Variation(t, a) for i, t in enumerate(room(SIZE, HORIZON)) for a in (ADVERSARIES, OTHERS)[i % 2]]


def independent(room: Room) -> list[Variation]:
    return [Variation(t, a) for t in room(SIZE, HORIZON) for a in ADVERSARIES]


def slow_labels(variations: list[Variation]) -> list[list[list[float]]]:
    """By variation and cell: uniform over the actions within the slack of the best."""
    found = []
    for variation in variations:
        memo: dict[tuple[tuple[int, int], int], list[float]] = {}
        values = [slow_q(variation, cell, HORIZON, GAMMA, memo) for cell in every_cell()]
        found.append([normalized([float(q >= max(row) - SLACK) for q in row]) for row in values])
    return found


def history(context: RoomContext, b: int) -> list[Transition]:
    columns = (context.observations[b], context.actions[b], context.rewards[b], context.next_observations[b])
    return [((int(s[0]), int(s[1])), int(a), float(r), (int(t[0]), int(t[1]))) for s, a, r, t in zip(*columns, strict=True)]


def walks(rows: list[Variation], seed: int = 0, kind: str = "random walk") -> RoomContext:
    return divergence.contexts(kind, rows, lambda _, env: RandomPolicy(ACTIONS), np.random.default_rng(seed).spawn(len(rows)))


def decide_of(run: Run, model: PretrainedTransformer) -> divergence.Decide:
    method = methods.of(run)
    return lambda *given: known(method.distributions(model, *given))


def measured(run: Run, model: PretrainedTransformer, heldout: bool) -> Iterator[tuple[Divergence, Divergence]]:
    """The divergences of a model that is deployed by Algorithm 1."""
    problem = registry.of(run)
    act = evaluate.in_context(TrainedModel(run, methods.of(run), problem.spec, model), run.context, "paper")
    return known(problem.posterior).divergences(run, decide_of(run, model), act, heldout)


@pytest.mark.parametrize("prior", [own, independent])
def test_exact_decisions_equal_enumeration(room: Room, prior: Callable[[Room], list[Variation]]) -> None:
    variations = prior(room)
    rows = [variations[m] for m in (3, 8, 17)]
    context = walks(rows)
    query = np.random.default_rng(1).integers(0, SIZE**2, size=(3, 2 * HORIZON + 1))
    h = Hypotheses.of(variations)
    decided = divergence.exact_decisions(h, soft_labels(h, GAMMA, SLACK), context, query)
    labels = slow_labels(variations)
    assert decided.shape == (3, 2 * HORIZON + 1, ACTIONS)
    for b in range(3):
        steps = history(context, b)
        for t in range(2 * HORIZON + 1):
            belief = normalized([math.prod(likelihood(v, one) for one in steps[:t]) for v in variations])
            slow = [sum(w * labels[m][query[b, t]][a] for m, w in enumerate(belief)) for a in range(ACTIONS)]
            np.testing.assert_allclose(decided[b, t], slow, atol=1e-6)
    assert np.abs(decided[:, 0] - decided[:, -1]).max() > 0.2, "the contexts changed nothing"


def test_model_decisions_are_the_models_one_prefix_at_a_time(
    run: Run, model: PretrainedTransformer, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(divergence, "_CHUNK", 2)
    context = walks([group[1] for group in divergence.training_variations(run, heldout=False)[:3]])
    length = context.actions.shape[1]
    query = np.random.default_rng(1).integers(0, 9, size=(3, length + 1))
    decided = divergence.model_decisions(decide_of(run, model), context, query, size=3)
    for b, t in itertools.product(range(3), range(length + 1)):
        seen = Transitions(*(torch.from_numpy(a[b : b + 1, :t].copy()) for a in context))
        state = torch.tensor([[divmod(int(query[b, t]), 3)]], dtype=torch.float32)
        with torch.inference_mode():
            expected = model.decide(state, model.encode(seen))[0, 0].double().softmax(dim=0)
        np.testing.assert_allclose(decided[b, t], expected.numpy(), atol=1e-5)


def test_the_first_prior_is_the_one_trained_on(run: Run) -> None:
    """Every training goal has its own adversaries; held-out goals are added with theirs, numbered after."""
    split = registry.of(run).split
    groups = [registry.training_variations(run, i, task) for i, task in enumerate((*split.train, *split.test))]
    assert (
        divergence.training_variations(run, heldout=False) == groups[:7]
        and divergence.training_variations(run, heldout=True) == groups[7:]
    )
    for heldout, chosen in ((False, groups[:7]), (True, groups)):
        h, _ = divergence.hypotheses(run, heldout)
        flat = [v for group in chosen for v in group]
        assert h.goal.tolist() == [3 * int(v.task.vector("goal")[0]) + int(v.task.vector("goal")[1]) for v in flat]
        assert h.p.tolist() == [0.0 if v.adversary == NULL else v.adversary.number("p") for v in flat]
        q = [[0.2] * 5 if v.adversary == NULL else argmax_distribution(v.adversary.vector("alpha")) for v in flat]
        np.testing.assert_allclose(h.q, np.array(q))


def test_by_the_second_prior_goals_and_adversaries_are_independent(run: Run) -> None:
    for heldout, goals in ((False, 7), (True, 9)):
        first, second = divergence.hypotheses(run, heldout)
        p, q = second.p.reshape(goals, -1), second.q.reshape(goals, -1, ACTIONS)
        assert (second.goal.reshape(goals, -1) == first.goal.reshape(goals, 2)[:, :1]).all()
        assert (p == p[0]).all() and (q == q[0]).all()
        assert p.shape[1] == 16 and (p == 0).mean() == (first.p == 0).mean() == 0.5
        assert len(set(p[0][p[0] > 0])) == 8 and 0 < p[0].max() <= run.adversary.p_max
        assert not set(p[0][p[0] > 0]) & set(first.p)


@pytest.mark.parametrize(
    "change",
    [{"method": "dpt"}, {"adversary": AdversaryConfig(count=0)}, {"adversary": AdversaryConfig(count=1, p_max=0.0)}],
)
def test_without_disturbance_in_training_there_is_none_in_the_contexts(
    run: Run, model: PretrainedTransformer, monkeypatch: pytest.MonkeyPatch, change: dict[str, Any]
) -> None:
    monkeypatch.setattr(divergence, "CONTEXTS", 2)
    run = dataclasses.replace(run, **change)
    found = [pair for heldout in (False, True) for pair in measured(run, model, heldout)]
    assert [(one.kind, one.p) for pair in found for one in pair] == [(kind, 0.0) for kind in (*KINDS, *KINDS) for _ in PRIORS]
    assert all((h.p == 0).all() for h in divergence.hypotheses(run, heldout=True))


def test_without_phi_0_in_training_contexts_at_p_0_are_undisturbed_and_no_prior_holds_it(
    run: Run, model: PretrainedTransformer, monkeypatch: pytest.MonkeyPatch
) -> None:
    made: list[Sequence[Variation]] = []
    monkeypatch.setattr(divergence, "CONTEXTS", 8)
    monkeypatch.setattr(divergence, "contexts", noting(made, lambda kind, rows, act, rngs: rows, divergence.contexts))
    run = dataclasses.replace(run, adversary=AdversaryConfig(count=2, null=False))
    assert {one.p for pair in measured(run, model, False) for one in pair} == {0.0, 0.2}
    assert [{v.adversary == NULL for v in rows} for rows in made] == [{True}] * len(KINDS) + [{False}] * len(KINDS)
    assert all((h.p > 0).all() for h in divergence.hypotheses(run, heldout=True))


class RecordsEnds(RandomPolicy):
    """Records the ``done`` of every step that it observes."""

    def __init__(self) -> None:
        super().__init__(ACTIONS)
        self.done: list[bool] = []

    def observe(self, *transition: object) -> None:
        self.done.append(bool(transition[-1]))


def fixed(agent: RecordsEnds, rows: Sequence[Variation], env: Batch) -> RecordsEnds:
    return agent


def test_walks_start_anywhere_and_deployments_in_the_origin(run: Run) -> None:
    rows = [group[1] for group in divergence.training_variations(run, heldout=False)] * 6
    again = {}
    for kind in KINDS:
        agent = RecordsEnds()
        context = divergence.contexts(kind, rows, functools.partial(fixed, agent), np.random.default_rng(0).spawn(len(rows)))
        starts = context.observations[:, :: run.section("darkroom").horizon]
        assert context.actions.shape == (42, 16) and starts.shape == (42, 2, 2)
        np.testing.assert_array_equal(context.observations[:, 1:8], context.next_observations[:, :7])
        if kind == "on policy":
            assert (starts == 0).all()
            assert agent.done == [*[False] * 7, True] * 2, "another agent acted in the second episode"
        else:
            assert agent.done == []
            assert all(len({tuple(cell) for cell in starts[:, n].tolist()}) == 9 for n in (0, 1))
            assert (starts[:, 0] != starts[:, 1]).any()
        again[kind] = (context.actions[:, 1:8] == context.actions[:, :7]).mean()
    assert abs(again["random walk"] - 0.2) < 0.1 < again["persistent walk"] - 0.6


@pytest.mark.parametrize("kind", KINDS)
def test_each_context_is_disturbed_by_its_own_adversary(run: Run, kind: str) -> None:
    down = Adversary.of("dirichlet", p=0.5, alpha=(0.1, 0.1, 0.1, 2.0, 0.1))
    rows = [Variation(group[0].task, a) for group in divergence.training_variations(run, heldout=False) for a in (NULL, down)]
    context = walks(rows, kind=kind)
    overridden = []
    for b, variation in enumerate(rows):
        steps = history(context, b)
        assert all(likelihood(variation, one) > 0 for one in steps)
        overridden.append(sum(likelihood(rows[b - b % 2], one) == 0 for one in steps))
    assert sum(overridden[0::2]) == 0 and sum(overridden[1::2]) > 7


@pytest.mark.parametrize("heldout", [False, True])
def test_contexts_take_the_goals_in_turn_each_under_one_of_its_adversaries(
    run: Run, model: PretrainedTransformer, monkeypatch: pytest.MonkeyPatch, heldout: bool
) -> None:
    monkeypatch.setattr(divergence, "CONTEXTS", 14)
    run = dataclasses.replace(run, adversary=AdversaryConfig(count=2))
    asked = list[tuple[str, list[Variation]]]()
    monkeypatch.setattr(divergence, "contexts", noting(asked, lambda kind, rows, *rest: (kind, rows), divergence.contexts))
    found = [(one.kind, one.p) for one, _ in measured(run, model, heldout)]
    assert [kind for kind, _ in asked] == [kind for kind, _ in found] and found == [(k, p) for p in (0.0, 0.2) for k in KINDS]
    groups = divergence.training_variations(run, heldout)
    for (_, p), (_, rows) in zip(found, asked, strict=True):
        assert [v.task for v in rows] == [groups[i % len(groups)][0].task for i in range(14)]
        if p == 0:
            assert all(v.adversary == NULL for v in rows)
        else:
            chosen = [
                [a.adversary.replace(p=p) for a in groups[i % len(groups)][1:]].index(v.adversary) for i, v in enumerate(rows)
            ]
            assert set(chosen) == {0, 1}


class Exact(PretrainedTransformer):
    """Acts as an untrained model; in given contexts its decisions are those of the exact posterior under one prior."""

    def set_hypotheses(self, run: Run, h: Hypotheses) -> None:
        soft = run.section("darkroom").labels == "soft"
        self.h, self.labels = h, soft_labels(h, GAMMA, SLACK) if soft else heuristic_labels(h)

    def forward(self, context: Transitions, queries: torch.Tensor, prefix: torch.Tensor) -> torch.Tensor:
        assert (prefix == torch.arange(prefix.shape[1])).all()
        query = cell_numbers(queries.numpy(), self.h.size)
        return torch.from_numpy(
            divergence.exact_decisions(self.h, self.labels, RoomContext(*(a.numpy() for a in context)), query)
        ).log()


class Uniform(PretrainedTransformer):
    """Every action has the same probability."""

    def forward(self, context: Transitions, queries: torch.Tensor, prefix: torch.Tensor) -> torch.Tensor:
        return torch.zeros(*prefix.shape, ACTIONS)


@pytest.mark.parametrize(("heldout", "labels"), [(False, "soft"), (True, "soft"), (True, "heuristic")])
@pytest.mark.parametrize("prior", range(len(PRIORS)))
def test_a_model_that_is_the_exact_posterior_has_no_divergence(
    run: Run, monkeypatch: pytest.MonkeyPatch, heldout: bool, labels: str, prior: int
) -> None:
    monkeypatch.setattr(divergence, "CONTEXTS", 9)
    run = in_problem(run, "darkroom", darkroom=dataclasses.replace(run.section("darkroom"), labels=labels))
    model = Exact(registry.of(run).spec, run.model).eval()
    model.set_hypotheses(run, divergence.hypotheses(run, heldout)[prior])
    found = list(zip(*measured(run, model, heldout), strict=True))
    assert all(np.abs(one.kl).max() < 1e-6 for one in found[prior])
    assert any(one.kl.mean() > 1e-3 for one in found[1 - prior]), "the two priors are equal"


def test_a_perfect_dr_model_which_ignores_the_disturbance_in_its_labels_has_no_divergence(
    run: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    """And ICAG's model has one by the labels of ``dr``: the disturbance changes the optimum."""
    monkeypatch.setattr(divergence, "CONTEXTS", 9)
    run = dataclasses.replace(run, method="dr", adversary=AdversaryConfig(count=1, p_max=1.0))
    model = Exact(registry.of(run).spec, run.model).eval()
    model.set_hypotheses(run, divergence.hypotheses(run, heldout=False)[0])
    assert any(one.kl.mean() > 1e-3 for one, _ in measured(run, model, heldout=False))
    tasks = [v.task for group in divergence.training_variations(run, heldout=False) for v in group]
    model.labels = soft_labels(Hypotheses.of([Variation(task) for task in tasks]), GAMMA, SLACK)
    assert all(np.abs(one.kl).max() < 1e-6 for one, _ in measured(run, model, heldout=False))


def test_the_divergence_of_a_uniform_model_equals_a_slow_loop(run: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(divergence, "CONTEXTS", 5)
    asked: list[RoomContext] = []
    monkeypatch.setattr(divergence, "contexts", keeping(asked, divergence.contexts))
    found = list(measured(run, Uniform(registry.of(run).spec, run.model).eval(), heldout=False))
    for (one, other), context in zip(found, asked, strict=True):
        assert one.kl.shape == one.reached.shape == (5, 17)
        for b, t in itertools.product(range(5), range(17)):
            assert one.reached[b, t] == other.reached[b, t] == any(context.rewards[b, :t] > 0)
            slow = sum(p * math.log(p / 0.2) for p in one.exact[b, t].tolist() if p > 0)
            assert one.kl[b, t] == pytest.approx(slow)
    assert {bool(m) for one, _ in found for m in one.reached.ravel()} == {False, True}


def made(kind: str, p: float, kl: list[list[float]], met: list[list[bool]]) -> Divergence:
    """A divergence of these nats: the exact decision is certain, the model's probability of it exp(-nats)."""
    sure = np.exp(-np.array(kl))
    exact = np.broadcast_to(np.eye(2)[0], (*sure.shape, 2)).copy()
    return Divergence(kind, p, exact, np.stack([sure, 1 - sure], axis=2), np.array(met))


def test_the_summary_is_split_by_whether_the_goal_was_met() -> None:
    one = made("random walk", 0.0, [[1.0, 2.0, 3.0], [4.0, 5.0, 9.0]], [[False, True, True], [False, False, True]])
    two = made("on policy", 0.2, [[6.0, 6.0, 6.0], [8.0, 8.0, 8.0]], [[False] * 3, [False] * 3])
    found = divergence.summary([one, two])
    assert found[""] == pytest.approx(66 / 12)
    assert found["_goal_met"] == pytest.approx((2 + 3 + 9) / 3)
    assert found["_goal_unmet"] == pytest.approx((1 + 4 + 5 + 42) / 9)
    first, second = found["_cells"]
    assert {k: v for k, v in first.items() if k in ("kind", "p")} == {"kind": "random walk", "p": 0.0}
    assert [first[k] for k in ("kl", "goal_met", "goal_unmet", "met")] == pytest.approx([4.0, 14 / 3, 10 / 3, 0.5])
    assert second["goal_met"] is None and second["met"] == 0.0
    # Of context means 2 and 6, and 6 and 8.
    errors = (np.std([2, 6], ddof=1) / math.sqrt(2), np.std([6, 8], ddof=1) / math.sqrt(2))
    assert [first["standard_error"], second["standard_error"]] == pytest.approx(errors)
    assert found["_standard_error"] == pytest.approx(math.hypot(*errors) / 2)


def test_curves_are_means_by_prefix_and_by_the_exact_probability() -> None:
    exact = np.array([[[0.0, 1.0], [0.25, 0.75]], [[0.0, 1.0], [0.28, 0.72]]])
    model = np.array([[[0.1, 0.9], [0.4, 0.6]], [[0.3, 0.7], [0.2, 0.8]]])
    one = Divergence("random walk", 0.2, exact, model, np.zeros((2, 2), bool))
    found = divergence.curves([one], bins=10)
    (curve,) = found["by_prefix"]
    assert (curve["kind"], curve["p"]) == ("random walk", 0.2)
    np.testing.assert_allclose(curve["kl"], one.kl.mean(axis=0))
    np.testing.assert_allclose(found["agreement"]["exact"], [0.0, 0.265, 0.735, 1.0])
    np.testing.assert_allclose(found["agreement"]["model"], [0.2, 0.3, 0.7, 0.8])


@pytest.mark.parametrize("kind", ["wind", "permuted"])
def test_every_context_of_an_inferred_disturbance_has_a_hypothesis(run: Run, kind: str) -> None:
    """With two adversaries a goal: the second prior has every direction or permutation, so no posterior is empty."""
    disturbed = override(run, [f"darkroom.disturbance={kind}", "adversary.p_max=1.0"], "test")
    config = registry.of(disturbed).config

    def decide(context: Sequence[np.ndarray], queries: np.ndarray, prefix: np.ndarray) -> np.ndarray:
        return np.full((*prefix.shape, ACTIONS), 1.0 / ACTIONS)

    found = list(divergence.divergences(disturbed, config, decide, lambda rows, env: RandomPolicy(ACTIONS), True))
    assert len(found) == len(KINDS) * 2
    for one in (prior for pair in found for prior in pair):
        np.testing.assert_allclose(one.exact.sum(axis=2), 1.0, rtol=1e-6)
    second = divergence.hypotheses(disturbed, True)[1]
    assert second.moves is not None
    null = (second.moves[:, range(ACTIONS), range(ACTIONS)] == 1).all(axis=1)
    assert null.mean() == pytest.approx(0.5), "phi_0 has its share, 1/K"
