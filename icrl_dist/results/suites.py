"""One evaluation, as the command and Python ask for it: settings, suite, report."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any, Literal, get_args

from icrl_dist.agent.loading import SHIPPED, open_checkpoint, shipped
from icrl_dist.config.paths import path_of
from icrl_dist.config.run import ConfigError, Deployment, parse_written, validate
from icrl_dist.console.display import Show, reporting
from icrl_dist.methods import registry as methods
from icrl_dist.models.compiled import Unusable, library
from icrl_dist.results import heldout, reports
from icrl_dist.results.reports import Evaluation
from icrl_dist.results.rows import is_unfinished
from icrl_dist.results.suite_numbers import ADVERSARIES, DRAWS, STEPS, numbers
from icrl_dist.storage.files import StoreError

Suite = Literal["online", "offline", "posterior", "attack", "worst"]
Prior = Literal["uniform", "unseen"]


def evaluate(
    what: str | Path,
    *,
    suite: Suite = "online",
    deploy: Deployment | None = None,
    episodes: int | None = None,
    seeds: int | None = None,
    p: Sequence[float] | float | None = None,
    prior: Prior | None = None,
    draws: int = DRAWS,
    adversaries: int = ADVERSARIES,
    steps: int = STEPS,
    references: bool = True,
    progress: Show = False,
) -> Evaluation:
    """Evaluate a trained agent on tasks that it did not train on, beside T^0, exact agents and the oracle.

    ``what``: a run folder, a checkpoint file, or the name of an agent of the package (``"darkroom"``; ``"./darkroom"``
    is a folder of that name).  The new rows are also written to ``results/`` of the run, the numbers and the figure to
    its ``report/``; for an agent of the package to runs/NAME-pretrained.  If a file cannot be written, for example in a
    folder that can only be read, the result is returned anyway, and one of its ``notes`` says so.

    ``suite``: ``online`` for consecutive episodes from an empty context; ``offline`` for one episode given the context
    of a random or an expert episode; ``posterior`` for the distance to the exact posterior; ``attack`` for one episode,
    given its context, without adversary, under sampled ones and under the worst one (Dark Room); ``worst`` for SAC
    adversaries that are trained against each agent (DeepMind Control).
    ``deploy``: the deployment rule, ``paper``, ``committed`` or ``growing``; None for the rule that the model was trained for.
    Suites ``posterior`` and ``worst`` always use ``paper``.
    ``episodes``: online episodes; ``seeds``: evaluations per task; ``p``: override probabilities of the test adversary,
    0 to 1; ``prior``: distribution of the test adversaries; evaluation e of a task is under adversary draw e.  None: the
    run's (suite ``posterior``: 40 episodes, 4 seeds, p 0, 0.2, 0.4 and 0.6, uniform; ``attack`` and ``worst``: the run's p
    above 0).  ``draws``: sampled adversaries of suite ``attack``.  ``adversaries``: of suite ``worst``, for each agent and
    task, with ``steps`` of training each.  ``references``: False leaves random policy, exact agents and oracle out.
    ``progress``: True shows it on standard output; a function receives each event, a dictionary.

    Raises ConfigError if there is no such agent or a setting is impossible, StoreError for a file that was not written
    by this system.  The messages name the options of the command line.
    """
    source, folder = _source_and_output(what)
    for option, value, choices in (("suite", suite, Suite), ("deploy", deploy, Deployment), ("prior", prior, Prior)):
        if value is not None and value not in get_args(choices):
            raise ConfigError(f"--{option} {value}: choose one of {', '.join(get_args(choices))}")
    run = parse_written(str(open_checkpoint(source).manifest["run"]), str(source))
    chosen: dict[str, Any] = {
        "episodes": episodes,
        "seeds": seeds,
        "p": None if p is None else _numbers("p", p),
        "prior": prior,
    }
    given = {name: value for name, value in chosen.items() if value is not None}
    if suite == "posterior" and not references:
        raise ConfigError("--suite posterior: it compares with the exact agent, a reference; leave --no-references out")
    if suite == "attack" and draws < 1:
        raise ConfigError(f"--draws {draws}: at least 1 sampled adversary is needed")
    for option, count in (("adversaries", adversaries), ("steps", steps)):
        if suite == "worst" and count < 1:
            raise ConfigError(f"--{option} {count}: at least 1 is needed")
    run = dataclasses.replace(run, evaluate=dataclasses.replace(run.evaluate, **numbers(run, suite, given)))
    validate(run, "evaluate")
    heldout.check_suite(run, suite)
    rule = "paper" if suite in ("posterior", "worst") else deploy or methods.of(run).deployment(run)
    report = folder / "report" / heldout.report_name(run, source, suite, rule)
    if suite == "attack":
        report = report.with_name(f"{report.name}-{draws}draws")
    if suite == "worst":
        report = report.with_name(f"{report.name}-{adversaries}adversaries-{steps}steps")
    if not references:
        report = report.with_name(f"{report.name}-no-references")
    results = (heldout.run_folder(source) or folder) / "results"  # rows of a checkpoint in a run folder belong to that run
    unstored: list[StoreError] = []
    with reporting(progress) as show:
        if source.is_dir() and is_unfinished(source):
            text = f"{source}: this run is not finished; the newest version so far is evaluated"
            show({"event": "note", "text": text})
        if run.context.decoder == "kernel" and isinstance(why := library("decoder"), Unusable):
            show({"event": "note", "text": f"torch computes the decisions, not the compiled decoder as in the run: {why}"})
        if suite == "online":
            rows = heldout.online(run, source, results, show, deploy, unstored, references)
            found = reports.online(run, report, rows, unstored)
        elif suite == "offline":
            found = reports.offline(run, heldout.offline(run, source, results, deploy, unstored, references), unstored)
        elif suite == "attack":
            rows = heldout.attack(run, source, results, show, draws, deploy, unstored, references)
            found = reports.attacked(run, report, rows, draws, unstored)
        elif suite == "worst":
            rows = heldout.worst(run, source, results, show, adversaries, steps, unstored, references)
            found = reports.worst(run, report, rows, adversaries, steps, unstored)
        else:
            found = reports.posterior(run, report, *heldout.posterior(run, source, results, show, unstored), unstored)
    answer = {"suite": suite, "deploy": rule, "what": str(source)}
    return dataclasses.replace(found, summary=answer | found.summary)


def _numbers(name: str, value: Sequence[float] | float) -> tuple[float, ...]:
    """Several numbers, or a single one."""
    listed = value if isinstance(value, Iterable) and not isinstance(value, str | bytes) else [value]
    try:
        return tuple(map(float, listed))
    except (TypeError, ValueError):
        raise ConfigError(f"{name} = {value!r}: expected a number or a list of numbers") from None


def _source_and_output(what: str | Path) -> tuple[Path, Path]:
    """The run folder or checkpoint to evaluate, and the folder that its report and result rows are written below."""
    if what in SHIPPED:
        return shipped(what), Path("runs") / f"{what}-pretrained"
    source = path_of("what", what)
    return source, source if source.is_dir() else source.parent
