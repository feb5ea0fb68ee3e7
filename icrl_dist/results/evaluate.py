"""Deployment of agents and of the problem's references on held-out tasks."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, TypeGuard

import numpy as np
from jaxtyping import Float

from icrl_dist.agent.trained_model import TrainedModel
from icrl_dist.config.run import Deployment, Run
from icrl_dist.config.sections import ContextConfig
from icrl_dist.interfaces import MakePolicy, Policy, Reference
from icrl_dist.problems import registry
from icrl_dist.results.statistics import mean_and_error
from icrl_dist.rollout.episode import Episodes, OfflinePolicy, deploy_offline, deploy_online, episode
from icrl_dist.types import Identity, Task, Variation


@dataclass(frozen=True, eq=False)
class Result:
    """Returns of one agent under adversaries of one strength, and the optimum of the same variations where it is known."""

    agent: str
    p: float
    returns: Float[np.ndarray, "tasks seeds episodes"]
    optimum: Float[np.ndarray, " tasks"] | None
    """Expected return of the optimal policy in each task's variation; None for a problem without exact answers."""
    ceiling: bool = False
    """The agent is given the task, so other returns are also shown as a share of its returns."""
    broken: int = 0
    """Episodes that ended early because the simulation diverged; their return up to that step counts."""

    def last(self, episodes: int) -> float:
        """Mean return over the last episodes."""
        return float(self.returns[:, :, -episodes:].mean())

    def first_over(self, oracle: Result, episodes: int) -> float | None:
        """Mean return over the first episodes (or all, if there are fewer), as a share of the oracle's in these episodes."""
        return _share(*(float(one.returns[:, :, :episodes].mean()) for one in (self, oracle)))

    def episode_of(self, oracle: Result, share: float) -> int | None:
        """First episode, from 1, whose mean return is at least this share of the oracle's mean over all episodes; or None."""
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
            "last5_over_optimum": None if best is None else _share(self.last(5), best),
            **({"broken": self.broken} if self.broken else {}),
        }


def _share(value: float, whole: float) -> float | None:
    """``value`` as a share of ``whole``; None if that is 0."""
    return round(value / whole, 4) if whole else None


def variations(run: Run, p: float, tasks: Sequence[Task] | None = None) -> tuple[Variation, ...]:
    """Every evaluated task (or each of ``tasks``) under its test adversary of strength p; starts are those of test episodes."""
    problem = registry.of(run)
    chosen = problem.evaluated if tasks is None else tasks
    return tuple(
        Variation(problem.at_test_start(task), registry.test_adversary(run, index, p, run.evaluate.prior))
        for index, task in enumerate(chosen)
    )


def in_context(trained: TrainedModel, context: ContextConfig, deploy: Deployment | None = None) -> MakePolicy:
    """The model as a policy with these context settings, deployed by this rule; None: the rule that it was trained for.

    All models of one table get the context settings of the evaluated run, also those that its fork's parent trained.
    """
    return lambda rows, env: trained.method.policy(trained.model, len(rows), context, deploy)


def online(
    run: Run,
    agents: Mapping[str, MakePolicy | Reference],
    progress: Callable[[str, float, int], None] = lambda agent, p, episodes: None,
    tasks: Sequence[Task] | None = None,
) -> list[Result]:
    """Online deployment (Algorithm 1, lines 9 to 17) of every agent at every p, with the same draws for all agents.

    ``tasks``: where to deploy; None: the evaluated tasks.
    """
    problem, results = registry.of(run), []
    for level, p in enumerate(run.evaluate.p):
        chosen = variations(run, p, tasks)
        optimum = None if problem.exact is None else problem.exact.optimum(chosen)
        rows, ids = _rows(run, chosen, level)
        for name, agent in agents.items():
            env = problem.batch(rows)
            trials = ([i._replace(trial=n).rng(run.seed) for i in ids] for n in range(run.evaluate.episodes))
            returns, broken = [], 0
            made, ceiling = (agent.make, agent.ceiling) if isinstance(agent, Reference) else (agent, False)
            for ran in deploy_online(env, made(rows, env), trials):
                returns.append(ran.returns)
                broken += _broken(ran)
                progress(name, p, len(returns))
            shape = (len(chosen), run.evaluate.seeds, run.evaluate.episodes)
            results.append(Result(name, p, np.stack(returns, axis=1).reshape(shape), optimum, ceiling, broken))
    return results


def offline(run: Run, models: Mapping[str, TrainedModel], deploy: Deployment | None = None) -> list[Result]:
    """Offline deployment (Algorithm 1, lines 3 to 7): one episode given a D_off of each of the ``sources``.

    Deploys every model, and every reference that accepts data of other policies.
    """
    problem, results = registry.of(run), []
    references = problem.references(run)
    for level, p in enumerate(run.evaluate.p):
        chosen = variations(run, p)
        optimum = None if problem.exact is None else problem.exact.optimum(chosen)
        rows, ids = _rows(run, chosen, level)
        env = problem.batch(rows)
        for source, behavior in sources(run).items():
            data = episode(env, behavior.make(rows, env), [i.rng(run.seed) for i in ids])
            shape = (len(chosen), run.evaluate.seeds, 1)
            results.append(Result(f"{source} data", p, data.returns.reshape(shape), optimum, broken=_broken(data)))
            policies: dict[str, Policy] = {
                name: in_context(one, run.context, deploy)(rows, env) for name, one in models.items()
            }
            policies |= {name: one.make(rows, env) for name, one in references.items()}
            for name, policy in policies.items():
                if _accepts_data(policy):
                    ran = deploy_offline(env, policy, [data], [i._replace(trial=1).rng(run.seed) for i in ids])
                    returns = ran.returns.reshape(shape)
                    results.append(Result(f"{name}, {source} data", p, returns, optimum, broken=_broken(ran)))
    return results


def sources(run: Run) -> dict[str, Reference]:
    """The references that collect D_off: ``random``, and ``expert``, the first that is a ceiling; those that there are."""
    references = registry.of(run).references(run)
    found = {"random": references.get("random"), "expert": next((one for one in references.values() if one.ceiling), None)}
    return {name: one for name, one in found.items() if one is not None}


def _broken(ran: Episodes) -> int:
    return 0 if ran.diverged is None else int(ran.diverged.sum())


def _accepts_data(policy: Policy) -> TypeGuard[OfflinePolicy]:
    return hasattr(policy, "append")


def _rows(run: Run, chosen: Sequence[Variation], level: int) -> tuple[list[Variation], list[Identity]]:
    """Every variation ``evaluate.seeds`` times, and the identity of each row's first episode."""
    pairs = [(i, seed) for i in range(len(chosen)) for seed in range(run.evaluate.seeds)]
    return [chosen[i] for i, _ in pairs], [Identity("evaluate", level, i, seed, 0) for i, seed in pairs]
