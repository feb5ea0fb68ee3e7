"""One evaluation of one run of a sweep: of its models without reference agents, or of these alone."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

from icrl_dist.config.run import Run
from icrl_dist.console.display import ReportEvent
from icrl_dist.problems import registry
from icrl_dist.results import attack, heldout, rows
from icrl_dist.results.evaluate import Agent
from icrl_dist.storage.checkpoint import newest_version, version_file
from icrl_dist.stream.schema import as_data
from icrl_dist.sweeps.file import Evaluation
from icrl_dist.sweeps.plan import evaluated

if TYPE_CHECKING:
    import pandas as pd


def do(run: Run, folder: Path, evaluation: Evaluation, exact: bool, show: ReportEvent) -> list[str]:
    """Evaluate the models of a run folder, or with ``exact`` the reference agents; returns the names of the files of rows."""
    run = evaluated(run, evaluation)
    frames = iter([_references(run, folder, evaluation, show)]) if exact else _models(run, folder, evaluation, show)
    return [f"{frame['evaluation'].iloc[0]}.parquet" for frame in frames]


def _references(run: Run, folder: Path, evaluation: Evaluation, show: ReportEvent) -> pd.DataFrame:
    if evaluation.suite != "attack":
        assert evaluation.suite != "posterior", "``plan`` gives it to trained runs only"
        return heldout.references(run, evaluation.suite, folder / "results", folder.name, show)
    agents = {Agent(key): reference for key, reference in registry.of(run).references(run).items()}
    settings = {"references": as_data(run.evaluate), "draws": evaluation.draws}
    return rows.record(folder / "results", "attack", settings, attack.blocks(run, agents, evaluation.draws, folder.name))


def _models(run: Run, folder: Path, evaluation: Evaluation, show: ReportEvent) -> Iterator[pd.DataFrame]:
    """Rows of T^0 and the newest model, and with ``rounds`` of those between them."""
    between = range(1, newest_version(folder)) if evaluation.rounds else ()
    results, rule = folder / "results", evaluation.deploy
    for what in (folder, *(version_file(folder, version) for version in between)):
        if evaluation.suite == "online":
            yield heldout.online(run, what, results, show, rule, with_references=False)
        elif evaluation.suite == "offline":
            yield heldout.offline(run, what, results, rule, with_references=False)
        elif evaluation.suite == "attack":
            yield heldout.attack(run, what, results, show, evaluation.draws, rule, with_references=False)
        else:
            yield heldout.posterior(run, what, results, show)[0]
