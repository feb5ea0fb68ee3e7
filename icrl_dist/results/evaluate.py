"""Deployment of agents and of the problem's references on held-out tasks."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple, TypeGuard

import numpy as np
from jaxtyping import Bool, Float, Float64

from icrl_dist.agent.trained_model import TrainedModel
from icrl_dist.config.random_keys import strength_key
from icrl_dist.config.run import ConfigError, Deployment, Run
from icrl_dist.config.sections import ContextConfig
from icrl_dist.interfaces import MakePolicy, Policy, Problem, Reference
from icrl_dist.methods import budget
from icrl_dist.problems import registry
from icrl_dist.results.returns import LAST
from icrl_dist.results.rows import Block
from icrl_dist.rollout.episode import Episodes, OfflinePolicy, append, episode
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
    variations: tuple[tuple[Variation, ...], ...]
    """By task and seed: evaluation e of a task has the adversary of draw e."""
    optimum: Float[np.ndarray, "tasks seeds"] | None = None
    """Expected return of the optimal policy in each variation; None for a problem without exact answers."""
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
        flat, row = _flat(self.variations), task * shape[1] + seed
        adversaries = [one.adversary for one in flat]
        optimum = np.full(shape[:2], np.nan) if self.optimum is None else self.optimum
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
            "task": np.array([parameters(one.task) for one in flat], object)[row],
            "p": self.p,
            "adversary_family": np.array([adversary.kind for adversary in adversaries], object)[row],
            "adversary_index": seed,
            "adversary": np.array([parameters(adversary) for adversary in adversaries], object)[row],
            "evaluation_seed": seed,
            "episode": number,
            "return": self.returns.ravel(),
            "optimum": optimum.ravel()[row],
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


def variations(run: Run, p: float, tasks: Sequence[Task] | None = None, draw: int = 0) -> tuple[Variation, ...]:
    """Every evaluated task (or each of ``tasks``) under its test adversary of strength p; starts are those of test episodes.

    ``draw``: number of the adversary draw.
    """
    problem = registry.of(run)
    chosen = problem.evaluated if tasks is None else tasks
    return tuple(
        Variation(problem.at_test_start(task), registry.test_adversary(run, index, p, run.evaluate.prior, draw))
        for index, task in enumerate(chosen)
    )


class Rows(NamedTuple):
    """What is evaluated at one p, for every task and, within it, every evaluation."""

    variations: tuple[tuple[Variation, ...], ...]
    """By task and evaluation."""
    flat: list[Variation]
    """The same, as the rows of one batch."""
    ids: list[Identity]
    """Identity of the first episode of each row."""
    optimum: Float64[np.ndarray, "tasks seeds"] | None

    @classmethod
    def of(cls, run: Run, p: float, tasks: Sequence[Task] | None = None) -> Rows:
        """Every task (None: every evaluated task) ``evaluate.seeds`` times, evaluation e with the adversary of draw e."""
        seeds, exact = range(run.evaluate.seeds), registry.of(run).exact
        chosen = tuple(zip(*(variations(run, p, tasks, seed) for seed in seeds), strict=True))
        flat = _flat(chosen)
        ids = [Identity("evaluate", strength_key(p), i, seed, 0) for i in range(len(chosen)) for seed in seeds]
        optimum = None if exact is None else np.asarray(exact.optimum(flat)).reshape(len(chosen), len(seeds))
        return cls(chosen, flat, ids, optimum)


def _flat(chosen: Sequence[Sequence[Variation]]) -> list[Variation]:
    return [one for of_task in chosen for one in of_task]


def certified(problem: Problem, policy: Policy, rows: Sequence[Variation], p: float) -> Float64[np.ndarray, " B"] | None:
    """Expected return of the next episode of each row, given its context, against the worst adversary of strength p.

    None if the problem has no ``certify``, and for a policy that changes within an episode.
    """
    if problem.certify is None or (policies := frozen(policy, problem.certify.states)) is None:
        return None
    return problem.certify.worst(policies, rows, p)


def frozen(policy: Any, states: Float[np.ndarray, "Q S"]) -> Float[np.ndarray, "P Q A"] | None:
    """``FrozenPolicy.frozen`` of a policy; None if it has none."""
    return policy.frozen(states) if hasattr(policy, "frozen") else None


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

    The last ``LAST`` episodes have the column ``certified`` of agents that have such a value.

    ``tasks``: where to deploy; None: the evaluated tasks.
    """
    problem, results = registry.of(run), []
    for p in run.evaluate.p:
        chosen, rows, ids, optimum = Rows.of(run, p, tasks)
        shape = (len(chosen), run.evaluate.seeds, run.evaluate.episodes)
        for name, agent in agents.items():
            env = problem.batch(rows)
            returns, broken, worst = [], [], np.full((len(rows), run.evaluate.episodes), np.nan)
            made, ceiling = (agent.make, agent.ceiling) if isinstance(agent, Reference) else (agent, False)
            policy = made(rows, env)
            for n in range(run.evaluate.episodes):
                late = n >= run.evaluate.episodes - LAST
                if late and (values := certified(problem, policy, rows, p)) is not None:
                    worst[:, n] = values
                ran = episode(env, policy, [i._replace(trial=n).rng(run.seed) for i in ids])
                returns.append(_checked(ran, run, name.key, p))
                broken.append(np.zeros(len(rows), bool) if ran.diverged is None else ran.diverged)
                progress(name.key, p, len(returns))
            total, diverged = (np.stack(of, axis=1).reshape(shape) for of in (returns, broken))
            extra = {"certified": worst.reshape(shape)}
            results.append(Result(name, p, total, chosen, optimum, ceiling, diverged, extra=extra))
    return results


def offline(
    run: Run, models: Mapping[Agent, TrainedModel], deploy: Deployment | None = None, with_references: bool = True
) -> list[Result]:
    """Offline deployment (Algorithm 1, lines 3 to 7): one episode given a D_off of each of the ``sources``.

    Deploys every model, and every reference that accepts data of other policies.  Without references, the results
    also leave out the episodes that are the data.
    """
    problem, results = registry.of(run), []
    references = {Agent(key): reference for key, reference in problem.references(run).items()}
    for p in run.evaluate.p:
        chosen, rows, ids, optimum = Rows.of(run, p)
        env = problem.batch(rows)
        shape = (len(chosen), run.evaluate.seeds, 1)
        for source, key in sources(run).items():
            behavior = Agent(key)
            data = episode(env, references[behavior].make(rows, env), [i.rng(run.seed) for i in ids])
            returns = _checked(data, run, key, p).reshape(shape)
            if with_references:
                results.append(Result(behavior, p, returns, chosen, optimum, diverged=_diverged(data, shape)))
            policies: dict[Agent, Policy] = {
                name: in_context(one, run.context, deploy)(rows, env) for name, one in models.items()
            }
            if with_references:
                policies |= {name: one.make(rows, env) for name, one in references.items()}
            for name, policy in policies.items():
                if _accepts_data(policy):
                    append(env, policy, [data])
                    worst = certified(problem, policy, rows, p)
                    ran = episode(env, policy, [i._replace(trial=1).rng(run.seed) for i in ids])
                    found = Result(name, p, _checked(ran, run, name.key, p).reshape(shape), chosen, optimum, data=source)
                    extra = {} if worst is None else {"certified": worst.reshape(shape)}
                    results.append(dataclasses.replace(found, diverged=_diverged(ran, shape), extra=extra))
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
