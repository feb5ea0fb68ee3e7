"""Where T_theta departs from the exact posterior (Theorem E.3), and what that costs in return.

Two measures: the divergence of its decisions from the Bayes-optimal ones in given contexts,
and its online return beside the exact agent's, deployed by the same rule.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float32, Float64, Int64
from scipy.special import rel_entr

from icrl_dist.config.run import ConfigError, Run
from icrl_dist.models.dpt import PretrainedTransformer, Transitions
from icrl_dist.problems import registry, splits
from icrl_dist.problems.darkroom.adversaries import adversary_set
from icrl_dist.problems.darkroom.behavior_policies import Walks
from icrl_dist.problems.darkroom.room import ACTIONS, cells
from icrl_dist.problems.darkroom.solver import (
    Hypotheses,
    cell_numbers,
    heuristic_labels,
    log_likelihood,
    posterior,
    posterior_action,
    soft_labels,
)
from icrl_dist.results import evaluate
from icrl_dist.results.evaluate import MakePolicy, Result
from icrl_dist.rollout.deployment import deploy_online, episode
from icrl_dist.types import Task, Variation

KINDS = ("random walk", "persistent walk", "on policy")
LEVELS = (0.0, 0.2)
LAWS = {"": "each goal has its own K adversaries", "_any": "any goal has any adversary"}
"""What may be true of a context, by the suffix of the measure's name.

The first is the law of D^0 (adversaries of ICAA's later rounds are others): the training
variations as they are, in which no two goals share a disturbance, so one can betray the goal.
By the second goals and adversaries are independent, as they are at test: every goal has the
same few, drawn anew from the prior.
"""
CONTEXTS, EPISODES = 160, 2
"""Contexts of each kind and p, and episodes a context."""
RESAMPLES = 4000
_ADVERSARIES = 16
_CHUNK = 32
_TRUTH = 104  # a spawn key that no trajectory and no task has (envs.tasks)


class Context(NamedTuple):
    """T transitions of each of B contexts: what ``Transitions`` holds, in numpy."""

    observations: Float32[np.ndarray, "B T S"]
    actions: Int64[np.ndarray, "B T"]
    next_observations: Float32[np.ndarray, "B T S"]
    rewards: Float32[np.ndarray, "B T"]


@dataclass(frozen=True, eq=False)
class Divergence:
    """The exact decision and the model's at one random cell, for every prefix of B contexts."""

    kind: str
    p: float
    exact: Float64[np.ndarray, "B T A"]
    model: Float64[np.ndarray, "B T A"]
    met: Bool[np.ndarray, "B T"]
    """The goal was met in the prefix."""

    @property
    def kl(self) -> Float64[np.ndarray, "B T"]:
        """KL(exact || T_theta), in nats."""
        result: np.ndarray = rel_entr(self.exact, self.model).sum(axis=2)
        return result


def variations(run: Run, heldout: bool) -> list[tuple[Variation, ...]]:
    """The K variations of every training goal, as trained on; of every held-out one, numbered after them."""
    split = splits.split(run)
    groups = [splits.variations(run, i, task)[: _count(run)] for i, task in enumerate((*split.train, *split.test))]
    return groups[len(split.train) :] if heldout else groups[: len(split.train)]


def _count(run: Run) -> int:
    return 1 if run.method == "dpt" else run.adversary.count


def levels(run: Run) -> tuple[float, ...]:
    """The p of contexts: 0 only, if training knows no disturbance, for by its law no other context is possible."""
    return LEVELS if _count(run) > 1 and run.adversary.p_max > 0 else LEVELS[:1]


def hypotheses(run: Run, heldout: bool) -> tuple[Hypotheses, Hypotheses]:
    """What may be true, equally, by each of ``LAWS``: of the training goals, or for held-out contexts of all goals."""
    groups = variations(run, False) + (variations(run, True) if heldout else [])
    rng = np.random.default_rng(np.random.SeedSequence(run.seed, spawn_key=(_TRUTH,)))
    sets = range(-(-_ADVERSARIES // _count(run)) if _count(run) > 1 else 1)
    several = [a for _ in sets for a in adversary_set(rng, _count(run), ACTIONS, run.adversary.p_max)]
    own = [v for group in groups for v in group]
    return Hypotheses.of(own), Hypotheses.of([Variation(group[0].task, a) for group in groups for a in several])


def divergences(run: Run, model: PretrainedTransformer, heldout: bool) -> Iterator[tuple[Divergence, Divergence]]:
    """T_theta beside the exact posterior by each of ``LAWS``, in contexts of every kind and p."""
    room, groups = run.darkroom, variations(run, heldout)
    laws = hypotheses(run, heldout)
    labels = [heuristic_labels(h) if room.labels == "heuristic" else soft_labels(h, room.gamma, room.label_slack) for h in laws]
    for level, p in enumerate(levels(run)):
        for number, kind in enumerate(KINDS):
            seed = np.random.SeedSequence(run.seed, spawn_key=(_TRUTH, int(heldout), level, number))
            rng = np.random.default_rng(seed)
            rows = [_disturbed(rng, groups[row % len(groups)], p) for row in range(CONTEXTS)]
            context = contexts(kind, rows, evaluate.in_context(run, model, "paper"), rng.spawn(CONTEXTS))
            query = rng.integers(0, room.size**2, size=(CONTEXTS, 1 + EPISODES * room.horizon))
            decided = model_decisions(model, context, query, room.size)
            met = np.pad(context.rewards.cumsum(axis=1) > 0, ((0, 0), (1, 0)))
            exact = (exact_decisions(h, known, context, query) for h, known in zip(laws, labels, strict=True))
            one, other = (Divergence(kind, p, law, decided, met) for law in exact)
            yield one, other


def _disturbed(rng: np.random.Generator, group: tuple[Variation, ...], p: float) -> Variation:
    """A goal's variation without disturbance, or one of its others at strength p."""
    if p == 0:
        return group[0]
    chosen = group[int(rng.integers(1, len(group)))]
    return Variation(chosen.task, chosen.adversary.replace(p=p))


def contexts(kind: str, rows: Sequence[Variation], act: MakePolicy, rngs: Sequence[np.random.Generator]) -> Context:
    """Two episodes in each row: walks from random cells as in training, or deployed as at test."""
    if kind == "on policy":
        rows = [Variation(splits.deployed(v.task), v.adversary) for v in rows]
        episodes = list(deploy_online(registry.batch(rows), act(rows), [rngs] * EPISODES))
    else:
        env, size = registry.batch(rows), int(rows[0].task.number("size"))
        walks = [Walks(size, env.spec.horizon, [kind.removesuffix(" walk")] * len(rows), rngs) for _ in range(EPISODES)]
        episodes = [episode(env, walk, rngs) for walk in walks]
    columns = [(e.observations[:, :-1], e.actions.astype(np.int64), e.observations[:, 1:], e.rewards) for e in episodes]
    return Context(*(np.concatenate(column, axis=1) for column in zip(*columns, strict=True)))


def exact_decisions(
    h: Hypotheses, labels: Float32[np.ndarray, "M C A"], context: Context, query: Int64[np.ndarray, "B N"]
) -> Float64[np.ndarray, "B N A"]:
    """P(a* | cell ``query[b, t]``, the first t transitions of context b), all of ``h`` equally likely before."""
    here, arrived = cell_numbers(context.observations, h.size), cell_numbers(context.next_observations, h.size)
    flat = np.full(len(h.p), -np.log(len(h.p)))
    result = []
    for b, cell in enumerate(query):
        steps = log_likelihood(h, here[b], context.actions[b], context.rewards[b], arrived[b])
        belief = posterior(flat, np.concatenate([np.zeros((1, len(h.p))), steps.cumsum(axis=0)]))
        result.append(posterior_action(belief, labels, cell))
    return np.stack(result)


@torch.inference_mode()
def model_decisions(
    model: PretrainedTransformer, context: Context, query: Int64[np.ndarray, "B N"], size: int
) -> Float64[np.ndarray, "B N A"]:
    """T_theta in the same places."""
    prefix = np.broadcast_to(np.arange(query.shape[1]), query.shape)
    result = []
    for first in range(0, len(query), _CHUNK):
        chunk = [np.array(a[first : first + _CHUNK]) for a in (*context, cells(size)[query], prefix)]
        *transitions, queries, seen = (torch.from_numpy(a).to(model.low.device) for a in chunk)
        logits: torch.Tensor = model(Transitions(*transitions), queries, seen)
        result.append(logits.double().softmax(dim=-1).cpu().numpy())
    return np.concatenate(result)


def summary(found: Sequence[Divergence]) -> dict[str, Any]:
    """Mean divergence in nats, its standard error over contexts, its parts before and after the goal was met; by kind and p.

    The keys are what comes after the measure's name.
    """
    rows = []
    for one in found:
        each = one.kl.mean(axis=1)
        error = float(each.std(ddof=1) / np.sqrt(len(each)))
        rows.append({"kind": one.kind, "p": one.p, **_split([one]), "standard_error": error, "met": float(one.met.mean())})
    spread = float(np.sqrt(sum(row["standard_error"] ** 2 for row in rows)) / len(rows))
    whole = {"" if name == "kl" else f"_{name}": value for name, value in _split(found).items()}
    return {**whole, "_standard_error": spread, "_cells": rows}


def _split(found: Sequence[Divergence]) -> dict[str, Any]:
    kl = np.concatenate([one.kl.ravel() for one in found])
    met = np.concatenate([one.met.ravel() for one in found])
    parts = {"kl": np.ones_like(met), "goal_met": met, "goal_unmet": ~met}
    return {name: float(kl[chosen].mean()) if chosen.any() else None for name, chosen in parts.items()}


def curves(found: Sequence[Divergence], bins: int = 10) -> dict[str, Any]:
    """What the figure shows: divergence by prefix, and the model's mean probability of the actions by the exact one."""
    exact = np.concatenate([one.exact.ravel() for one in found])
    model = np.concatenate([one.model.ravel() for one in found])
    place = np.minimum((exact * bins).astype(np.int64), bins - 1)
    count = np.bincount(place, minlength=bins)
    sums = (np.bincount(place, weights=w, minlength=bins)[count > 0] / count[count > 0] for w in (exact, model))
    return {
        "by_prefix": [{"kind": one.kind, "p": one.p, "kl": one.kl.mean(axis=0).tolist()} for one in found],
        "agreement": dict(zip(("exact", "model"), (s.tolist() for s in sums), strict=True)),
    }


def gaps(
    run: Run,
    act: MakePolicy,
    goals: Sequence[Task],
    progress: Callable[[str, float, int], None] = lambda agent, p, episodes: None,
) -> dict[str, Any]:
    """By p: how far the online return of an agent is from the exact agent's under Algorithm 1, as a share of it.

    Both meet the same goals, adversaries and chance; the mean is over all episodes.
    """
    agents = {"model": act, "exact": evaluate.exact(run, "paper")}
    results = evaluate.online(run, agents, progress, goals)
    return {f"{model.p:g}": gap(model, exact, run.seed) for model, exact in zip(results[::2], results[1::2], strict=True)}


def gap(model: Result, exact: Result, seed: int) -> dict[str, float]:
    """Ratio of mean returns less 1, with its 95% bootstrap interval: goals, and of each its seeds, drawn anew in pairs."""
    one, two = (r.returns.mean(axis=2) for r in (model, exact))
    goals, seeds = one.shape
    rng = np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(_TRUTH,)))
    chosen = rng.integers(0, goals, size=(RESAMPLES, goals, 1)), rng.integers(0, seeds, size=(RESAMPLES, goals, seeds))
    if not two.mean() > 0:
        raise ConfigError(f"the exact agent's return is {two.mean():g} at p = {model.p:g}: no ratio to it; try more --episodes")
    above = two[chosen].mean(axis=(1, 2))
    low, high = np.percentile(one[chosen].mean(axis=(1, 2))[above > 0] / above[above > 0] - 1, (2.5, 97.5))
    means = {"model": float(one.mean()), "exact": float(two.mean())}
    return {"gap": means["model"] / means["exact"] - 1, "low": float(low), "high": float(high), **means}
