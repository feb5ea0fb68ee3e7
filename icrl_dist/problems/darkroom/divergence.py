"""Divergence of T_theta's decisions from those of the exact posterior (Theorem E.3) in given contexts.

``results/posterior.py`` adds the second measure of the suite: the difference in online return.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float32, Float64, Int64
from scipy.special import rel_entr

from icrl_dist.config import plugins
from icrl_dist.config.random_keys import RandomKey, generator
from icrl_dist.config.run import Run
from icrl_dist.interfaces import Batch, MakePolicy
from icrl_dist.problems import registry
from icrl_dist.problems.darkroom.adversaries import grid
from icrl_dist.problems.darkroom.behavior_policies import Walks
from icrl_dist.problems.darkroom.config import DarkRoomConfig
from icrl_dist.problems.darkroom.labels import labels_of
from icrl_dist.problems.darkroom.room import ACTIONS, DarkRoom, cells
from icrl_dist.problems.darkroom.solver import Hypotheses, cell_numbers, log_likelihood, posterior, posterior_action
from icrl_dist.rollout.episode import deploy_online, episode
from icrl_dist.types import NULL, Variation

Decide = Callable[[Sequence[np.ndarray], Float32[np.ndarray, "B N S"], Int64[np.ndarray, "B N"]], Float64[np.ndarray, "B N A"]]
"""A model's distributions at query states, each given its own prefix of the transitions (``Method.distributions``)."""

KINDS = ("random walk", "persistent walk", "on policy")
LEVELS = (0.0, 0.2)
PRIORS = {"": "each goal has its own adversaries", "_any": "any goal has any adversary"}
"""Priors over variations, by the suffix of the measure's name.

The first is that of D^0 (later rounds of ICAA draw other adversaries): the training variations.
Because no two goals share an adversary, the disturbance can reveal the goal.  In the second, goals and
adversaries are independent, as in tests: every goal has the same adversaries, drawn from the prior.
"""
CONTEXTS, EPISODES = 160, 2
"""Contexts of each kind and p, and episodes per context."""
_ADVERSARIES = 16
"""Approximate number of adversaries of the second prior: a multiple of the variations per goal that is not smaller."""
_LEVELS = 4
"""Strengths of the winds, or of the permuted controls, of the second prior."""
_CHUNK = 32
"""Contexts per call of the model."""


class RoomContext(NamedTuple):
    """T transitions of each of B contexts, as in ``models.dpt.Transitions``, in numpy."""

    observations: Float32[np.ndarray, "B T S"]
    actions: Int64[np.ndarray, "B T"]
    next_observations: Float32[np.ndarray, "B T S"]
    rewards: Float32[np.ndarray, "B T"]


@dataclass(frozen=True, eq=False)
class Divergence:
    """The exact and the model's action distribution at one random cell, for every prefix of B contexts."""

    kind: str
    p: float
    exact: Float64[np.ndarray, "B T A"]
    model: Float64[np.ndarray, "B T A"]
    reached: Bool[np.ndarray, "B T"]
    """Whether the goal was reached in the prefix."""

    @property
    def kl(self) -> Float64[np.ndarray, "B T"]:
        """KL(exact || T_theta), in nats."""
        result: np.ndarray = rel_entr(self.exact, self.model).sum(axis=2)
        return result


def training_variations(run: Run, heldout: bool) -> list[tuple[Variation, ...]]:
    """The variations of each training goal; with ``heldout`` of each test goal, numbered after the training goals."""
    split, method = registry.of(run).split, plugins.find("methods", run.method)()
    tasks = enumerate((*split.train, *split.test))
    groups = [method.training_variations(run, i, task, 0) for i, task in tasks]
    return groups[len(split.train) :] if heldout else groups[: len(split.train)]


def levels(run: Run) -> tuple[float, ...]:
    """The override probabilities of contexts: only 0 if training has no disturbance, because its prior allows no other."""
    return LEVELS if _disturbed_of(training_variations(run, False)[0]) and run.adversary.p_max > 0 else LEVELS[:1]


def hypotheses(run: Run, heldout: bool) -> tuple[Hypotheses, Hypotheses]:
    """The equally likely variations of each of ``PRIORS``: those of training goals; for held-out contexts of all goals.

    In the second, winds and permuted controls are a grid: a few random ones may lack the direction of a context, whose
    probability would then be 0 under every variation.
    """
    groups = training_variations(run, False) + (training_variations(run, True) if heldout else [])
    rng = generator(run.seed, RandomKey.POSTERIOR_SUITE)
    trained = [v.adversary for v in groups[0]]
    sets = range(-(-_ADVERSARIES // len(trained))) if trained != [NULL] else ()
    several = [a for _ in sets for a in registry.adversaries(run, rng)] or trained
    kind = registry.of(run).config.disturbance
    if kind != "override" and sets:
        others = grid(kind, ACTIONS, run.adversary.p_max, _LEVELS, run.adversary.p_min)
        share = trained.count(NULL) / len(trained)  # phi_0 keeps its share
        several = [*[NULL] * round(len(others) * share / (1 - share)), *others]
    own = [v for group in groups for v in group]
    return Hypotheses.of(own), Hypotheses.of([Variation(group[0].task, a) for group in groups for a in several])


def divergences(
    run: Run, config: DarkRoomConfig, decide: Decide, act: MakePolicy, heldout: bool
) -> Iterator[tuple[Divergence, Divergence]]:
    """Compare T_theta with the exact posterior under each of ``PRIORS``, in contexts of every kind and p."""
    room, groups = config, training_variations(run, heldout)
    priors = hypotheses(run, heldout)
    labels = [labels_of(of, room.labels, room.gamma, room.label_slack) for of in _labelled(run, priors)]
    for level, p in enumerate(levels(run)):
        for number, kind in enumerate(KINDS):
            rng = generator(run.seed, RandomKey.POSTERIOR_SUITE, int(heldout), level, number)
            rows = [_disturbed(rng, groups[row % len(groups)], p) for row in range(CONTEXTS)]
            context = contexts(kind, rows, act, rng.spawn(CONTEXTS))
            query = rng.integers(0, room.size**2, size=(CONTEXTS, 1 + EPISODES * room.horizon))
            decided = model_decisions(decide, context, query, room.size)
            reached = np.pad(context.rewards.cumsum(axis=1) > 0, ((0, 0), (1, 0)))
            exact = (exact_decisions(h, optimal, context, query) for h, optimal in zip(priors, labels, strict=True))
            one, other = (Divergence(kind, p, probs, decided, reached) for probs in exact)
            yield one, other


def _labelled(run: Run, priors: Sequence[Hypotheses]) -> Sequence[Hypotheses]:
    """The hypotheses that labels come from: those of the method ``dr`` have no disturbance."""
    method = plugins.find("methods", run.method)()
    payload = method.ask(run, method.phases(run)[0])[0].payload
    if not getattr(getattr(payload, "labelling", None), "undisturbed", False):
        return priors
    q = np.full(ACTIONS, 1 / ACTIONS)
    return [Hypotheses(h.size, h.horizon, h.goal, np.zeros(len(h.goal)), np.tile(q, (len(h.goal), 1))) for h in priors]


def _disturbed(rng: np.random.Generator, group: tuple[Variation, ...], p: float) -> Variation:
    """The undisturbed variation of a goal, or a random other one with override probability p."""
    if p == 0:
        return Variation(group[0].task)
    others = _disturbed_of(group)
    chosen = others[int(rng.integers(len(others)))]
    return Variation(chosen.task, chosen.adversary.replace(p=p))


def _disturbed_of(group: tuple[Variation, ...]) -> list[Variation]:
    return [one for one in group if one.adversary != NULL]


def contexts(kind: str, rows: Sequence[Variation], act: MakePolicy, rngs: Sequence[np.random.Generator]) -> RoomContext:
    """Two episodes in each row: walks from random cells as in training, or the model deployed as in tests."""
    if kind == "on policy":
        rows = [Variation(v.task.replace(start=(0, 0)), v.adversary) for v in rows]
        env: Batch = DarkRoom(rows)
        episodes = list(deploy_online(env, act(rows, env), [rngs] * EPISODES))
    else:
        env, size = DarkRoom(rows), int(rows[0].task.number("size"))
        walks = [Walks(size, env.spec.horizon, [kind.removesuffix(" walk")] * len(rows), rngs) for _ in range(EPISODES)]
        episodes = [episode(env, walk, rngs) for walk in walks]
    columns = [(e.observations[:, :-1], e.actions.astype(np.int64), e.observations[:, 1:], e.rewards) for e in episodes]
    return RoomContext(*(np.concatenate(column, axis=1) for column in zip(*columns, strict=True)))


def exact_decisions(
    h: Hypotheses, labels: Float32[np.ndarray, "M C A"], context: RoomContext, query: Int64[np.ndarray, "B N"]
) -> Float64[np.ndarray, "B N A"]:
    """P(a* | cell ``query[b, t]``, the first t transitions of context b), with a uniform prior over ``h``."""
    here, arrived = cell_numbers(context.observations, h.size), cell_numbers(context.next_observations, h.size)
    flat = np.full(len(h.p), -np.log(len(h.p)))
    result = []
    for b, cell in enumerate(query):
        steps = log_likelihood(h, here[b], context.actions[b], context.rewards[b], arrived[b])
        belief = posterior(flat, np.concatenate([np.zeros((1, len(h.p))), steps.cumsum(axis=0)]))
        result.append(posterior_action(belief, labels, cell))
    return np.stack(result)


def model_decisions(
    decide: Decide, context: RoomContext, query: Int64[np.ndarray, "B N"], size: int
) -> Float64[np.ndarray, "B N A"]:
    """The model's distributions at the same cells and prefixes."""
    prefix = np.broadcast_to(np.arange(query.shape[1]), query.shape)
    result = []
    for first in range(0, len(query), _CHUNK):
        *transitions, queries, seen = [np.array(a[first : first + _CHUNK]) for a in (*context, cells(size)[query], prefix)]
        result.append(decide(transitions, queries, seen))
    return np.concatenate(result)


def summary(found: Sequence[Divergence]) -> dict[str, Any]:
    """Mean divergence in nats, before and after the goal was reached, and its standard error; also by kind and p.

    The keys are suffixes of the measure's name.
    """
    rows = []
    for one in found:
        each = one.kl.mean(axis=1)
        error = float(each.std(ddof=1) / np.sqrt(len(each)))
        row = {"kind": one.kind, "p": one.p, **_split([one]), "standard_error": error, "contexts": len(each)}
        rows.append({**row, "met": float(one.reached.mean())})
    spread = float(np.sqrt(sum(row["standard_error"] ** 2 for row in rows)) / len(rows))
    whole = {"" if name == "kl" else f"_{name}": value for name, value in _split(found).items()}
    return {**whole, "_standard_error": spread, "_cells": rows}


def _split(found: Sequence[Divergence]) -> dict[str, Any]:
    kl = np.concatenate([one.kl.ravel() for one in found])
    reached = np.concatenate([one.reached.ravel() for one in found])
    parts = {"kl": np.ones_like(reached), "goal_met": reached, "goal_unmet": ~reached}
    return {name: float(kl[chosen].mean()) if chosen.any() else None for name, chosen in parts.items()}


def curves(found: Sequence[Divergence], bins: int = 10) -> dict[str, Any]:
    """Data of the figure: divergence by prefix, and the model's mean probability as a function of the exact one."""
    exact = np.concatenate([one.exact.ravel() for one in found])
    model = np.concatenate([one.model.ravel() for one in found])
    place = np.minimum((exact * bins).astype(np.int64), bins - 1)
    count = np.bincount(place, minlength=bins)
    sums = (np.bincount(place, weights=w, minlength=bins)[count > 0] / count[count > 0] for w in (exact, model))
    return {
        "by_prefix": [{"kind": one.kind, "p": one.p, "kl": one.kl.mean(axis=0).tolist()} for one in found],
        "agreement": dict(zip(("exact", "model"), (s.tolist() for s in sums), strict=True)),
    }


class RoomPosteriorSuite:
    """The comparison with the exact posterior, as ``Problem.posterior``."""

    kinds, priors = KINDS, PRIORS
    levels = staticmethod(levels)
    summary = staticmethod(summary)
    curves = staticmethod(curves)

    def __init__(self, config: DarkRoomConfig) -> None:
        self._config = config

    def divergences(self, run: Run, decide: Decide, act: MakePolicy, heldout: bool) -> Iterator[tuple[Divergence, Divergence]]:
        """See ``divergences``."""
        return divergences(run, self._config, decide, act, heldout)
