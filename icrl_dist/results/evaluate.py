"""Deploying agents on held-out tasks, beside the oracle that knows task and adversary."""

from __future__ import annotations

import functools
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float, Float32

from icrl_dist.config.run import DarkRoomConfig, Deployment, Run
from icrl_dist.experts import cache, train
from icrl_dist.experts.train import ScriptedPolicy
from icrl_dist.methods.recipes import Dataset, Phase, self_labelled
from icrl_dist.models.dpt import PretrainedTransformer
from icrl_dist.problems import registry, splits
from icrl_dist.problems.darkroom import room as darkroom
from icrl_dist.problems.darkroom.exact_agents import RULES, ExactAgent, OptimalAgent, Rule
from icrl_dist.problems.darkroom.room import ACTIONS
from icrl_dist.problems.darkroom.solver import Hypotheses, cell_numbers, optimal_returns, soft_labels
from icrl_dist.results.statistics import mean_and_error
from icrl_dist.rollout import deployment
from icrl_dist.rollout.deployment import Actor, Policy, RandomActor, RandomPolicy, deploy_offline, deploy_online, episode
from icrl_dist.types import Adversary, Identity, Task, Variation

MakePolicy = Callable[[Sequence[Variation]], Policy | Actor]
ORACLE = "oracle"
EXPERT, SCRIPTED = "SAC expert", "scripted expert"
"""Of a continuous game: the experts of the undisturbed tasks, and Meta-World's policy that is told the goal."""


@dataclass(frozen=True, eq=False)
class Result:
    """Returns of one agent at one disturbance, and the exact optimum of the same variations where it is known."""

    agent: str
    p: float
    returns: Float[np.ndarray, "tasks seeds episodes"]
    optimum: Float[np.ndarray, " tasks"] | None
    """Expected return of the optimal policy in each task's variation, by value iteration; None in a continuous game."""
    broken: int = 0
    """Episodes that ended early because the simulation broke down: they count with what they had earned by then."""

    def last(self, episodes: int) -> float:
        """Mean return over the last episodes."""
        return float(self.returns[:, :, -episodes:].mean())

    def first_over(self, oracle: Result, episodes: int) -> float:
        """Mean return over the first episodes (or all, if there are fewer), as a share of the oracle's in the same ones."""
        return round(float(self.returns[:, :, :episodes].mean() / oracle.returns[:, :, :episodes].mean()), 4)

    def episode_of(self, oracle: Result, share: float) -> int | None:
        """First episode, from 1, whose mean return is this share of the oracle's over all episodes; None if none is."""
        good = self.returns.mean(axis=(0, 1)) >= share * oracle.returns.mean()
        return int(good.argmax()) + 1 if good.any() else None

    def row(self) -> dict[str, Any]:
        """The result as plain values, for JSON."""
        mean, error = mean_and_error(self.returns)
        best = None if self.optimum is None else float(self.optimum.mean())
        return {
            "agent": self.agent,
            "p": self.p,
            "episodes": [round(float(m), 3) for m in mean],
            "standard_error": [None if np.isnan(e) else round(float(e), 3) for e in error],
            "optimum": None if best is None else round(best, 3),
            "last5": round(self.last(5), 3),
            "last5_over_optimum": None if best is None else round(self.last(5) / best, 4),
            **({"broken": self.broken} if self.broken else {}),
        }


def variations(run: Run, p: float, goals: Sequence[Task] | None = None) -> tuple[Variation, ...]:
    """Every evaluated task (or these) under its test adversary of strength p, started in the origin."""
    chosen = splits.evaluated(run) if goals is None else goals
    return tuple(
        Variation(splits.deployed(t), splits.test_adversary(run, i, p, run.evaluate.prior)) for i, t in enumerate(chosen)
    )


def in_context(run: Run, model: PretrainedTransformer, deploy: Deployment | None = None) -> MakePolicy:
    """T_theta, deployed by this rule or the better one that it was trained for."""
    return lambda rows: deployment.in_context(model, len(rows), run.context, deploy)


def random(rows: Sequence[Variation]) -> Policy:
    """The uniform policy."""
    return RandomPolicy(ACTIONS)


def random_vectors(rows: Sequence[Variation]) -> Actor:
    """Uniform over vectors."""
    return RandomActor()


def scripted(rows: Sequence[Variation]) -> Actor:
    """Meta-World's scripted policy."""
    return ScriptedPolicy()


def expert(run: Run, chosen: Sequence[Task]) -> MakePolicy | None:
    """The SAC experts of these tasks, undisturbed, if they were trained on this machine."""
    asked = {task: cache.any_kept(Variation(task), run.sac, run.seed) for task in chosen}
    found = {task: history for task, history in asked.items() if history is not None}
    if len(found) < len(asked):
        return None
    return lambda rows: train.ExpertPolicy([found[row.task] for row in rows], run.sac)


def optimal(run: Run) -> MakePolicy:
    """The oracle, which follows pi*_{tau,phi} of every row."""

    def make(rows: Sequence[Variation]) -> Policy:
        hypotheses = Hypotheses.of(rows)
        return OptimalAgent(soft_labels(hypotheses, run.darkroom.gamma, slack=0.0), hypotheses.size)

    return make


@functools.lru_cache(maxsize=64)
def _any_goal(room: DarkRoomConfig, adversary: Adversary) -> tuple[Hypotheses, Float32[np.ndarray, "M C A"]]:
    goals = [darkroom.task(divmod(cell, room.size), room.size, room.horizon) for cell in range(room.size**2)]
    hypotheses = Hypotheses.of([Variation(goal, adversary) for goal in goals])
    return hypotheses, soft_labels(hypotheses, room.gamma, room.label_slack)


def exact(run: Run, rule: Rule) -> Callable[[Sequence[Variation]], ExactAgent]:
    """The exact agent that knows every row's adversary and holds each cell for the goal, all equally."""

    def make(rows: Sequence[Variation]) -> ExactAgent:
        adversaries = list(dict.fromkeys(v.adversary for v in rows))
        families, labels = zip(*(_any_goal(run.darkroom, a) for a in adversaries), strict=True)
        return ExactAgent(families, labels, np.array([adversaries.index(v.adversary) for v in rows]), rule)

    return make


def online(
    run: Run,
    agents: Mapping[str, MakePolicy],
    progress: Callable[[str, float, int], None] = lambda agent, p, episodes: None,
    goals: Sequence[Task] | None = None,
) -> list[Result]:
    """Online deployment (Algorithm 1, lines 9 to 17) of every agent at every p, same chance for all.

    On the held-out tasks, or those given.
    """
    results = []
    for level, p in enumerate(run.evaluate.p):
        chosen = variations(run, p, goals)
        optimum = optimal_returns(Hypotheses.of(chosen)) if run.problem == "darkroom" else None
        rows, ids = _rows(run, chosen, level)
        for name, make in agents.items():
            env = registry.batch(rows)
            trials = ([i._replace(trial=n).rng(run.seed) for i in ids] for n in range(run.evaluate.episodes))
            returns, broken = [], 0
            policy = make(rows)
            if isinstance(policy, ScriptedPolicy):
                policy.meet(env)
            for ran in deploy_online(env, policy, trials):
                returns.append(ran.returns)
                broken += 0 if ran.diverged is None else int(ran.diverged.sum())
                progress(name, p, len(returns))
            shape = (len(chosen), run.evaluate.seeds, run.evaluate.episodes)
            results.append(Result(name, p, np.stack(returns, axis=1).reshape(shape), optimum, broken))
    return results


def offline(run: Run, agents: Mapping[str, PretrainedTransformer], deploy: Deployment | None = None) -> list[Result]:
    """Offline deployment (Algorithm 1, lines 3 to 7): one episode given a random or expert D_off.

    Of every model and every exact agent.
    """
    results = []
    for level, p in enumerate(run.evaluate.p):
        chosen = variations(run, p)
        optimum = optimal_returns(Hypotheses.of(chosen))
        rows, ids = _rows(run, chosen, level)
        env = registry.batch(rows)
        for source, behavior in (("random", random), ("expert", optimal(run))):
            data = episode(env, behavior(rows), [i.rng(run.seed) for i in ids])
            shape = (len(chosen), run.evaluate.seeds, 1)
            results.append(Result(f"{source} data", p, data.returns.reshape(shape), optimum))
            ran = {}
            for name, model in agents.items():
                policy = deployment.in_context(model, len(rows), run.context, deploy)
                ran[name] = deploy_offline(env, policy, [data], [i._replace(trial=1).rng(run.seed) for i in ids])
            for rule, name in RULES.items():
                agent = exact(run, rule)(rows)
                agent.append(data.observations[:, :-1], data.actions, data.observations[:, 1:], data.rewards)
                ran[name] = episode(env, agent, [i._replace(trial=1).rng(run.seed) for i in ids])
            results += [Result(f"{name}, {source} data", p, r.returns.reshape(shape), optimum) for name, r in ran.items()]
    return results


def _rows(run: Run, chosen: Sequence[Variation], level: int) -> tuple[list[Variation], list[Identity]]:
    """Every variation ``evaluate.seeds`` times, and the identity of each row's first episode."""
    pairs = [(i, seed) for i in range(len(chosen)) for seed in range(run.evaluate.seeds)]
    return [chosen[i] for i, _ in pairs], [Identity("evaluate", level, i, seed, 0) for i, seed in pairs]


def label_quality(run: Run, phase: Phase, data: Dataset) -> dict[str, float]:
    """How good a round's own labels are, against the exact answer (Theorem E.5, measured).

    ``agreement``: share of labels that the optimal policy would also take; ``labelling``: share
    of the variations that gave labels; the mean return of
    the trials that became contexts and of those that gave labels; the optimum beside them.
    Empty for a phase whose labels are not the model's own.
    """
    if phase.stage != "adapt" or run.method != "icaa" or run.problem != "darkroom":
        return {}
    agreement, early, late, best = [], [], [], []
    for trials in map(data.trials, data.variations(phase.stage, phase.round)):
        hypotheses = Hypotheses.of([trials[0].variation])
        truth = soft_labels(hypotheses, run.darkroom.gamma, run.darkroom.label_slack)[0]
        own = self_labelled(run, trials)
        if own is not None:
            good = truth[cell_numbers(own.queries, hypotheses.size), own.labels.argmax(axis=1)] > 0
            agreement.append(good.mean())
        cut = run.icaa.context_trials + 1
        early.append(np.mean([t.episode_return for t in trials[:cut]]))
        late.append(np.mean([t.episode_return for t in trials[cut:]]))
        best.append(optimal_returns(hypotheses)[0])
    return {
        "agreement": float(np.mean(agreement)) if agreement else 0.0,
        "labelling": len(agreement) / len(early),
        "context_return": float(np.mean(early)),
        "label_return": float(np.mean(late)),
        "optimum": float(np.mean(best)),
    }
