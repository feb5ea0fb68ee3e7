"""Deployment of agents and of the problem's references on held-out tasks."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple, TypeGuard

import numpy as np
from jaxtyping import Bool, Float

from icrl_dist.agent.trained_model import TrainedModel
from icrl_dist.config.random_keys import strength_key
from icrl_dist.config.run import ConfigError, Deployment, Run
from icrl_dist.config.sections import ContextConfig
from icrl_dist.interfaces import MakePolicy, Policy, Reference
from icrl_dist.methods import budget
from icrl_dist.problems import registry
from icrl_dist.results.rows import Block
from icrl_dist.rollout.episode import Episodes, OfflinePolicy, deploy_offline, deploy_online, episode
from icrl_dist.types import Adversary, Identity, Task, Variation


class Agent(NamedTuple):
    """Names an evaluated agent in result rows; see the columns of the same names in docs/data.md."""

    key: str
    """``t2`` for T^2, or the key of a reference agent."""
    deployment: str = ""
    policy_version: int = -1
    weights_digest: str = ""


@dataclass(frozen=True, eq=False)
class Result:
    """Returns of one agent under adversaries of one strength, with what is known of the same variations."""

    agent: Agent
    p: float
    returns: Float[np.ndarray, "tasks seeds episodes"]
    variations: tuple[Variation, ...]
    """One per task."""
    optimum: Float[np.ndarray, " tasks"] | None = None
    """Expected return of the optimal policy in each task's variation; None for a problem without exact answers."""
    ceiling: bool = False
    """The agent is given the task, so other returns are also shown as a share of its returns."""
    diverged: Bool[np.ndarray, "tasks seeds episodes"] | None = None
    """Episodes that ended early because the simulation diverged; None if it cannot."""
    data: str = ""
    """Offline: the agent whose episode is the context."""
    extra: dict[str, np.ndarray] = field(default_factory=dict)
    """More columns of the result rows, of the shape of ``returns``."""

    def block(self, run: Run, name: str, tasks: str) -> Block:
        """The result as result rows.  ``name``: of the run; ``tasks``: which tasks these are."""
        shape = self.returns.shape
        task, seed, number = (index.ravel() for index in np.indices(shape))
        adversaries = [one.adversary for one in self.variations]
        optimum = np.full(shape[0], np.nan) if self.optimum is None else self.optimum
        diverged = np.zeros(shape, bool) if self.diverged is None else self.diverged
        return {
            **of_run(run, name),
            "tasks": tasks,
            "agent": self.agent.key,
            "policy_version": self.agent.policy_version,
            "weights_digest": self.agent.weights_digest,
            "deployment": self.agent.deployment,
            "ceiling": self.ceiling,
            "data": self.data,
            "prior": run.evaluate.prior,
            "task_index": task,
            "task": np.array([parameters(one.task) for one in self.variations], object)[task],
            "p": self.p,
            "adversary_family": np.array([adversary.kind for adversary in adversaries], object)[task],
            "adversary_index": task,
            "adversary": np.array([parameters(adversary) for adversary in adversaries], object)[task],
            "evaluation_seed": seed,
            "episode": number,
            "return": self.returns.ravel(),
            "optimum": optimum[task],
            "diverged": diverged.ravel(),
            **{name: values.ravel() for name, values in self.extra.items()},
        }


def of_run(run: Run, name: str) -> Block:
    """The columns of result rows that are equal in all rows of a run."""
    return {
        "run": name,
        "method": run.method,
        "problem": run.problem,
        "training_seed": run.seed,
        "setting": "",
        "variant": run.method,
        "adversaries": run.adversary.count,
        "split_seed": budget.split_seed(run),
        **budget.columns(run),
    }


def parameters(of: Task | Adversary) -> str:
    """The parameters of a task or an adversary as JSON, with sorted names."""
    return json.dumps(dict(of.params), sort_keys=True)


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
    agents: Mapping[Agent, MakePolicy | Reference],
    progress: Callable[[str, float, int], None] = lambda agent, p, episodes: None,
    tasks: Sequence[Task] | None = None,
) -> list[Result]:
    """Online deployment (Algorithm 1, lines 9 to 17) of every agent at every p, with the same draws for all agents.

    ``tasks``: where to deploy; None: the evaluated tasks.
    """
    problem, results = registry.of(run), []
    for p in run.evaluate.p:
        chosen = variations(run, p, tasks)
        optimum = None if problem.exact is None else problem.exact.optimum(chosen)
        rows, ids = _rows(run, chosen, p)
        shape = (len(chosen), run.evaluate.seeds, run.evaluate.episodes)
        for name, agent in agents.items():
            env = problem.batch(rows)
            trials = ([i._replace(trial=n).rng(run.seed) for i in ids] for n in range(run.evaluate.episodes))
            returns, broken = [], []
            made, ceiling = (agent.make, agent.ceiling) if isinstance(agent, Reference) else (agent, False)
            for ran in deploy_online(env, made(rows, env), trials):
                returns.append(_checked(ran, run, name.key, p))
                broken.append(np.zeros(len(rows), bool) if ran.diverged is None else ran.diverged)
                progress(name.key, p, len(returns))
            values, diverged = (np.stack(of, axis=1).reshape(shape) for of in (returns, broken))
            results.append(Result(name, p, values, chosen, optimum, ceiling, diverged))
    return results


def offline(run: Run, models: Mapping[Agent, TrainedModel], deploy: Deployment | None = None) -> list[Result]:
    """Offline deployment (Algorithm 1, lines 3 to 7): one episode given a D_off of each of the ``sources``.

    Deploys every model, and every reference that accepts data of other policies.
    """
    problem, results = registry.of(run), []
    references = {Agent(key): reference for key, reference in problem.references(run).items()}
    for p in run.evaluate.p:
        chosen = variations(run, p)
        optimum = None if problem.exact is None else problem.exact.optimum(chosen)
        rows, ids = _rows(run, chosen, p)
        env = problem.batch(rows)
        shape = (len(chosen), run.evaluate.seeds, 1)
        for source, key in sources(run).items():
            behavior = Agent(key)
            data = episode(env, references[behavior].make(rows, env), [i.rng(run.seed) for i in ids])
            returns = _checked(data, run, key, p).reshape(shape)
            results.append(Result(behavior, p, returns, chosen, optimum, diverged=_diverged(data, shape)))
            policies: dict[Agent, Policy] = {
                name: in_context(one, run.context, deploy)(rows, env) for name, one in models.items()
            }
            policies |= {name: one.make(rows, env) for name, one in references.items()}
            for name, policy in policies.items():
                if _accepts_data(policy):
                    ran = deploy_offline(env, policy, [data], [i._replace(trial=1).rng(run.seed) for i in ids])
                    found = Result(name, p, _checked(ran, run, name.key, p).reshape(shape), chosen, optimum, data=source)
                    results.append(dataclasses.replace(found, diverged=_diverged(ran, shape)))
    return results


def sources(run: Run) -> dict[str, str]:
    """Keys of the references that collect D_off: ``random``, and as ``expert`` the first ceiling; those that there are."""
    references = registry.of(run).references(run)
    found = {"random": "random" if "random" in references else None}
    found["expert"] = next((key for key, one in references.items() if one.ceiling), None)
    return {name: key for name, key in found.items() if key is not None}


def _checked(ran: Episodes, run: Run, agent: str, p: float) -> np.ndarray:
    """The returns of a batch of episodes.  Raises ConfigError at once for one that is no finite number."""
    if wrong := int((~np.isfinite(ran.returns)).sum()):
        raise ConfigError(
            f"evaluation of agent {agent} at p = {p:g}: the return is no finite number in {wrong} of {ran.returns.size} "
            f"episodes; mend the rewards of problem {run.problem}"
        )
    return ran.returns


def _diverged(ran: Episodes, shape: tuple[int, ...]) -> np.ndarray | None:
    return None if ran.diverged is None else ran.diverged.reshape(shape)


def _accepts_data(policy: Policy) -> TypeGuard[OfflinePolicy]:
    return hasattr(policy, "append")


def _rows(run: Run, chosen: Sequence[Variation], p: float) -> tuple[list[Variation], list[Identity]]:
    """Every variation ``evaluate.seeds`` times, and the identity of each row's first episode."""
    pairs = [(i, seed) for i in range(len(chosen)) for seed in range(run.evaluate.seeds)]
    return [chosen[i] for i, _ in pairs], [Identity("evaluate", strength_key(p), i, seed, 0) for i, seed in pairs]
