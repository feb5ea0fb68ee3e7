"""The suite ``attack``: one episode of an agent, given its context, against several adversaries of one strength.

The contexts are those of an online evaluation.  From the same context the next episode meets no adversary, the uniform
one, several of the unseen prior, and the worst one.  Under Algorithm 1 the agent is a Markov policy in this episode, so
all these returns are exact expectations (``Problem.certify``); other agents are deployed once against each adversary.
"""

from __future__ import annotations

import copy
from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from jaxtyping import Float64
from rich.table import Table

from icrl_dist.config.run import Run
from icrl_dist.interfaces import MakePolicy, Reference
from icrl_dist.problems import registry
from icrl_dist.results import statistics
from icrl_dist.results.evaluate import Agent, Result, Rows, frozen
from icrl_dist.results.names import MINIMAX, AgentKey, names
from icrl_dist.results.rows import Block
from icrl_dist.results.tables import NarrowTable
from icrl_dist.rollout.episode import episode
from icrl_dist.types import NULL, Adversary, Variation

if TYPE_CHECKING:
    import pandas as pd

_SHOWN = (1, 2, 5, 10)


class Attack(NamedTuple):
    """One adversary of every task."""

    prior: str
    """Column ``prior``: ``uniform``, ``unseen``, or empty for no adversary."""
    draw: int
    adversaries: tuple[Adversary, ...]
    """By task."""


def attacks(run: Run, p: float, tasks: int, draws: int) -> list[Attack]:
    """No adversary, the uniform one, and ``draws`` of the unseen prior, all of strength p."""
    chosen = [("uniform", 0), *(("unseen", draw) for draw in range(draws))]
    found = [Attack(of, k, tuple(registry.test_adversary(run, i, p, of, k) for i in range(tasks))) for of, k in chosen]
    return [Attack("", 0, (NULL,) * tasks), *found]


def numbers(episodes: int) -> list[int]:
    """The episodes, from 0, that are attacked: of ``episodes`` a few early ones, and the last."""
    return sorted({one - 1 for one in _SHOWN if one < episodes} | {episodes - 1})


def blocks(
    run: Run,
    agents: Mapping[Agent, MakePolicy | Reference],
    draws: int,
    name: str,
    progress: Callable[[str, float, int], None] = lambda agent, p, episodes: None,
) -> list[Block]:
    """The result rows of the suite.  ``name``: of the run.

    References whose policy changes within an episode are left out.  The rows of the minimax oracle have its return against
    the worst adversary, which does not depend on the episode.
    """
    problem, made = registry.of(run), []
    certificate = problem.certify
    assert certificate is not None, "``heldout.check_suite`` refuses problems without it"
    chosen = numbers(run.evaluate.episodes)
    for p in run.evaluate.p:
        rows = Rows.of(run, p)
        found = attacks(run, p, len(rows.variations), draws)
        for agent, how in agents.items():
            env = problem.batch(rows.flat)
            policy = how.make(rows.flat, env) if isinstance(how, Reference) else how(rows.flat, env)
            if isinstance(how, Reference) and frozen(policy, certificate.states) is None:
                continue
            returns = np.zeros((len(found), len(rows.flat), len(chosen)))
            certified = np.full((len(rows.flat), len(chosen)), np.nan)
            for n in range(run.evaluate.episodes):
                rngs = [[i._replace(trial=n).rng(run.seed) for i in rows.ids] for _ in range(len(found) + 1)]
                if n in chosen:
                    at, policies = chosen.index(n), frozen(policy, certificate.states)
                    if policies is not None:
                        certified[:, at] = certificate.worst(policies, rows.flat, p)
                    for k, attack in enumerate(found):
                        against = _attacked(rows, attack)
                        if policies is not None:
                            returns[k, :, at] = certificate.expected(policies, against)
                        else:
                            returns[k, :, at] = episode(problem.batch(against), copy.deepcopy(policy), rngs[k]).returns
                episode(env, policy, rngs[-1])
                progress(agent.key, p, n + 1)
            for attack, values in zip(found, returns, strict=True):
                made.append(_block(run, name, agent, p, rows, attack, values, chosen, {"certified": certified}))
        best = np.repeat(certificate.worst(None, rows.flat, p)[:, None], len(chosen), axis=1)
        worst = Attack("", 0, (Adversary.of("worst"),) * len(rows.variations))
        made.append(_block(run, name, Agent(MINIMAX), p, rows, worst, best, chosen, {"certified": best}, exact=False))
    return made


def _attacked(rows: Rows, attack: Attack) -> list[Variation]:
    pairs = zip(rows.variations, attack.adversaries, strict=True)
    return [Variation(one.task, adversary) for of_task, adversary in pairs for one in of_task]


def _block(
    run: Run,
    name: str,
    agent: Agent,
    p: float,
    rows: Rows,
    attack: Attack,
    returns: Float64[np.ndarray, "B N"],
    chosen: Sequence[int],
    extra: Mapping[str, np.ndarray],
    exact: bool = True,
) -> Block:
    """The rows of one agent against one adversary of each task."""
    shape = len(rows.variations), run.evaluate.seeds, len(chosen)
    against, solver = _attacked(rows, attack), registry.of(run).exact if exact else None
    optimum = None if solver is None else np.asarray(solver.optimum(against)).reshape(shape[:2])
    nested = tuple(tuple(against[i * shape[1] : (i + 1) * shape[1]]) for i in range(shape[0]))
    columns = {name: values.reshape(shape) for name, values in extra.items()}
    found = Result(agent, p, returns.reshape(shape), nested, optimum, extra=columns).block(run, name, "evaluated")
    return {
        **found,
        "prior": attack.prior,
        "adversary_index": attack.draw,
        "episode": np.array(chosen)[found["episode"]],
    }


def summary(frame: pd.DataFrame) -> list[dict[str, Any]]:
    """One entry for each p, agent and episode (from 1), as JSON values.

    ``nominal``, ``uniform``, ``sampled`` (mean over the sampled adversaries), ``worst_sampled`` (of each task the lowest of
    them), ``certified`` (None without one) and ``minimax``: each a pair, the mean over tasks and the lowest task.
    """
    first = frame.iloc[0]
    agents = [AgentKey(*key) for key in frame[["agent", "deployment", "data"]].drop_duplicates().itertuples(index=False)]
    named = names([agent for agent in agents if agent.agent != MINIMAX], "attack", first["method"], first["problem"])
    answer = []
    for (p, number), here in frame.groupby(["p", "episode"]):
        minimax = _pair(here[here["agent"] == MINIMAX].groupby("task_index")["return"].mean())
        for agent, name in named.items():
            own = here[(here["agent"] == agent.agent) & (here["deployment"] == agent.deployment)]
            by = own.groupby(["prior", "task_index", "adversary_index"])["return"].mean()
            entry = {
                "p": float(p),
                "agent": name,
                "key": agent.agent,
                "deployment": agent.deployment,
                "episode": int(number) + 1,
                "nominal": _pair(by[""]),
                "uniform": _pair(by["uniform"]),
                "sampled": _pair(by["unseen"].groupby("task_index").mean()),
                "worst_sampled": _pair(by["unseen"].groupby("task_index").min()),
                "certified": None if own["certified"].isna().any() else _pair(own.groupby("task_index")["certified"].mean()),
                "minimax": minimax,
            }
            answer.append(entry)
    return sorted(answer, key=lambda entry: (entry["p"], list(named.values()).index(entry["agent"]), entry["episode"]))


def _pair(by_task: pd.Series) -> list[float]:
    return [round(float(by_task.mean()), 3), round(float(by_task.min()), 3)]


def table(run: Run, found: Sequence[Mapping[str, Any]], title: str, draws: int) -> Table:
    """One row for each p, agent and episode; ``found``: ``summary``."""
    tasks, seeds = registry.of(run).evaluated_count, run.evaluate.seeds
    caption = (
        "each cell: mean over goals / lowest goal, of the expected return of this one episode, given the context of the "
        f"episodes before it ({statistics.counted(tasks, 'task')}, {statistics.counted(seeds, 'context')} of each, collected "
        f"under draws of the prior {run.evaluate.prior}); the lowest of noisy means lies below the lowest true one.  worst "
        f"sampled: of each goal the lowest of {draws} adversaries of "
        "the unseen prior.  certified: against the worst adversary that overrides actions with probability p, knows the policy "
        "and chooses by state and step; exact; the minimax oracle is the best policy against it.  It certifies one episode "
        "given its context, and not an adversary that also acts while the context is collected.  "
        "estimated: the context grows "
        "within the episode, so nothing is exact and there is no certificate; the worst of the sampled adversaries instead.  "
        "One training: it says nothing about other training seeds"
    )
    shown = NarrowTable(title=title, title_justify="left", caption=caption, caption_justify="left")
    shown.spare = ("uniform", "sampled")
    for header in ("p", "agent", "episode", "nominal", "uniform", "sampled", "worst sampled", "certified", "minimax oracle"):
        shown.add_column(header, justify="left" if header == "agent" else "right")
    before: Mapping[str, Any] = {}
    for row in found:
        certified = _cell(row["certified"]) if row["certified"] else f"{_cell(row['worst_sampled'])} estimated"
        same = before.get("p") == row["p"]
        shown.add_row(
            "" if same else f"{row['p']:g}",
            "" if same and before["agent"] == row["agent"] else row["agent"],
            str(row["episode"]),
            *(_cell(row[name]) for name in ("nominal", "uniform", "sampled", "worst_sampled")),
            certified,
            _cell(row["minimax"]),
        )
        before = row
    return shown


def _cell(pair: Sequence[float]) -> str:
    return f"{pair[0]:.1f} / {pair[1]:.1f}"
