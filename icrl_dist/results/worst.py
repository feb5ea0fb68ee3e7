"""The suite ``worst``: returns under SAC adversaries that were trained against each agent alone.

Each agent first has undisturbed episodes.  Then a fresh adversary is trained against it in each row (task and adversary
number), while its context stays as it is (Algorithm 1).  It is evaluated against this adversary so (``frozen``), and an
in-context agent also from an empty context that grows under it (``adapting``).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from rich.table import Table

from icrl_dist.config.run import Run
from icrl_dist.experts.adversarial import worst_case
from icrl_dist.experts.cache import expert_seed
from icrl_dist.interfaces import MakePolicy, Reference
from icrl_dist.problems import registry
from icrl_dist.results import statistics
from icrl_dist.results.evaluate import Agent, Result
from icrl_dist.results.names import AgentKey, names
from icrl_dist.results.rows import Block
from icrl_dist.results.tables import NarrowTable
from icrl_dist.rollout.episode import episode
from icrl_dist.types import NULL, Adversary, Identity, Variation

if TYPE_CHECKING:
    import pandas as pd

FROZEN, ADAPTING = "frozen", "adapting"
"""Column ``data``: the context stays as it was when the adversary was trained; it begins empty and grows."""


def blocks(
    run: Run,
    agents: Mapping[Agent, MakePolicy | Reference],
    adversaries: int,
    steps: int,
    name: str,
    progress: Callable[[str, float, int], None] = lambda agent, p, steps: None,
) -> list[Block]:
    """The result rows of the suite.  ``adversaries``: of each task; ``steps``: of each one's training; ``name``: of the run.

    Adversaries have the settings of ``[sac]``, and p times ``control.strength``.  Seeds depend on task and number alone, so
    all agents meet equal starts and adversaries that began equally.  ``progress`` is given agent, p and steps so far.
    """
    problem, made = registry.of(run), []
    player = problem.second_player
    assert player is not None, "``heldout.check_suite`` refuses problems without it"
    tasks = [problem.at_test_start(task) for task in problem.evaluated]
    rows, numbers = [Variation(task) for task in tasks for _ in range(adversaries)], list(range(adversaries)) * len(tasks)
    seeds = [worst_case.adversary_seed(expert_seed(row, run.seed), number) for row, number in zip(rows, numbers, strict=True)]
    ids = [Identity("evaluate", 0, row // adversaries, number, 0) for row, number in enumerate(numbers)]

    def block(agent: Agent, p: float, found: worst_case.Returns, data: str = "") -> Block:
        shape = len(tasks), adversaries, found.returns.shape[1]
        strength = {"steps": steps, "strength": p * player.strength}
        chosen = tuple(
            tuple(Variation(task, Adversary.of("sac", number=n, **strength) if data else NULL) for n in range(adversaries))
            for task in tasks
        )
        diverged = found.diverged.reshape(shape)
        return Result(agent, p, found.returns.reshape(shape), chosen, diverged=diverged, data=data).block(
            run, name, "evaluated"
        )

    for agent, how in agents.items():
        make = how.make if isinstance(how, Reference) else how
        env = problem.batch(rows)
        policy = make(rows, env)
        ran = [episode(env, policy, [i._replace(trial=n).rng(run.seed) for i in ids]) for n in range(run.evaluate.episodes)]
        broken = [np.zeros(len(rows), bool) if one.diverged is None else one.diverged for one in ran]
        returns = worst_case.Returns(np.stack([one.returns for one in ran], axis=1), np.stack(broken, axis=1))
        made.append(block(agent, 0.0, returns))
        for p in run.evaluate.p:
            game = player.batch([row.task for row in rows], p * player.strength)

            def report(done: int, key: str = agent.key, p: float = p) -> None:
                progress(key, p, done)

            trained = worst_case.trained_adversaries(game, policy, run.sac, steps, seeds, report)
            found = worst_case.against(game, policy, trained, seeds, run.evaluate.episodes)
            made.append(block(agent, p, found, FROZEN))
            if not isinstance(how, Reference):
                found = worst_case.against(game, make(rows, env), trained, seeds, run.evaluate.episodes, adapt=True)
                made.append(block(agent, p, found, ADAPTING))
    return made


def summary(frame: pd.DataFrame) -> list[dict[str, Any]]:
    """One entry for each p and agent, as JSON values; each return is a mean over the evaluation's episodes and over tasks.

    ``undisturbed``; ``mean`` over the adversaries of a task, and the ``worst`` of them, both with the context ``frozen``;
    ``adapting_mean`` and ``adapting_worst`` for in-context agents, else None; ``lowest``: the ``worst`` of the lowest task.
    """
    first = frame.iloc[0]
    keys = frame[["agent", "deployment"]].drop_duplicates().itertuples(index=False)
    named = names([AgentKey(*key) for key in keys], "worst", first["method"], first["problem"])
    answer = []
    for p in sorted(frame.loc[frame["data"] != "", "p"].unique()):
        for agent, name in named.items():
            own = frame[(frame["agent"] == agent.agent) & (frame["deployment"] == agent.deployment)]
            by = own[own["p"] == p].groupby(["data", "task_index", "adversary_index"])["return"].mean()
            entry = {"p": float(p), "agent": name, "key": agent.agent, "deployment": agent.deployment}
            entry["undisturbed"] = _rounded(own.loc[own["data"] == "", "return"].mean())
            for data, prefix in ((FROZEN, ""), (ADAPTING, "adapting_")):
                tasks = by[data].groupby("task_index") if data in by.index.levels[0] else None
                entry[f"{prefix}mean"] = None if tasks is None else _rounded(tasks.mean().mean())
                entry[f"{prefix}worst"] = None if tasks is None else _rounded(tasks.min().mean())
            entry["lowest"] = _rounded(by[FROZEN].min())
            answer.append(entry)
    return answer


def _rounded(value: float) -> float:
    return round(float(value), 3)


def table(found: Sequence[Mapping[str, Any]], title: str, adversaries: int, steps: int, episodes: int) -> Table:
    """One row for each p and agent; ``found``: ``summary``."""
    caption = (
        f"for each agent and task, {adversaries} SAC adversaries are trained for {steps:,} steps against this agent, whose "
        f"context is that of {statistics.counted(episodes, 'undisturbed episode')}.  Returns are means over "
        f"{statistics.counted(episodes, 'episode')} and over tasks.  mean: over the adversaries.  worst: of each task the "
        "adversary with the lowest mean, which lies below the lowest true mean, because means are noisy.  lowest: the worst of "
        "the lowest task.  adapting: the context begins empty and grows under the same adversary.  More steps may find "
        "stronger adversaries, so nothing here is a bound.  One training: it says nothing about other training seeds"
    )
    shown = NarrowTable(title=title, title_justify="left", caption=caption, caption_justify="left")
    columns = ("undisturbed", "mean", "worst", "lowest", "adapting_mean", "adapting_worst")
    for header in ("p", "agent", *(column.replace("_", " ") for column in columns)):
        shown.add_column(header, justify="left" if header == "agent" else "right")
    for row in found:
        cells = ("-" if row[column] is None else f"{row[column]:.1f}" for column in columns)
        shown.add_row(f"{row['p']:g}", row["agent"], *cells)
    return shown
