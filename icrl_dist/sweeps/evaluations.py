"""One evaluation of one run of a sweep: of its models without reference agents, or of these alone."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from icrl_dist.config.run import Run
from icrl_dist.console.display import ReportEvent
from icrl_dist.interfaces import MakePolicy, Reference
from icrl_dist.problems import registry
from icrl_dist.results import evaluate, heldout, rows
from icrl_dist.results.evaluate import Agent, Result
from icrl_dist.stream.schema import as_data
from icrl_dist.sweeps.file import Evaluation
from icrl_dist.sweeps.plan import evaluated


def do(run: Run, folder: Path, evaluation: Evaluation, exact: bool, show: ReportEvent) -> str:
    """Evaluate the models of a run folder, or with ``exact`` the reference agents; returns the name of the file of rows."""
    run = evaluated(run, evaluation)
    if evaluation.suite == "posterior":
        frame, _ = heldout.posterior(run, folder, folder / "results", show)
        return f"{frame['evaluation'].iloc[0]}.parquet"
    references = registry.of(run).references(run)
    agents: dict[Agent, MakePolicy | Reference] = {Agent(key): reference for key, reference in references.items()}
    if not exact:
        models = heldout.models(folder, evaluation.deploy)
        agents = {agent: evaluate.in_context(model, run.context, evaluation.deploy) for agent, model in models.items()}
    found: Sequence[Result]
    if evaluation.suite == "online":
        done = 0

        def progress(agent: str, p: float, episodes: int) -> None:
            nonlocal done
            done += 1
            steps = len(agents) * len(run.evaluate.p) * run.evaluate.episodes
            show({"event": "progress", "stage": "evaluate", "phase": "evaluate", "step": done, "steps": steps})

        found = evaluate.online(run, agents, progress)
    else:
        every = evaluate.offline(run, {} if exact else models, evaluation.deploy)
        found = [one for one in every if one.agent in agents]
    blocks = [one.block(run, folder.name, "evaluated") for one in found]
    return rows.append(folder / "results", evaluation.suite, as_data(run.evaluate), blocks).name
