"""Evaluation of a run folder's models on held-out tasks, compared with references: reports, figures and tables."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, Float32, Float64, Int64
from rich.console import Console

from icrl_dist.agent import ood_score
from icrl_dist.agent.loading import calibrated, checkpoint_file, outcomes_of, trained
from icrl_dist.agent.ood_score import Surprise
from icrl_dist.agent.trained_model import TrainedModel
from icrl_dist.config.run import ConfigError, Deployment, Run
from icrl_dist.console.display import Display
from icrl_dist.interfaces import Batch, MakePolicy, Method, Policy, Reference
from icrl_dist.methods import registry as methods
from icrl_dist.problems import registry
from icrl_dist.results import evaluate, plots
from icrl_dist.results import posterior as posterior_suite
from icrl_dist.results.tables import experts_table, gap_table, kl_table, returns_table
from icrl_dist.storage.checkpoint import Checkpoint, load_checkpoint, save_checkpoint
from icrl_dist.storage.dataset import Dataset
from icrl_dist.storage.files import atomic_write
from icrl_dist.types import Variation


def models(what: Path) -> dict[str, TrainedModel]:
    """The newest model and, in a run folder with adapted versions, T^0; by the name that tables show."""
    newest = load_checkpoint(checkpoint_file(what))
    version = newest.manifest["version"]
    found = {f"T^{version} ({newest.manifest['method']})": trained(newest)}
    if what.is_dir() and version > 0:
        found["T^0"] = trained(load_checkpoint(checkpoint_file(what, 0)))
    return found


def calibrate(what: Path, display: Display) -> Checkpoint:
    """The newest checkpoint with its outcome readout, which is fitted now if it is missing."""

    def progress(episodes: int) -> None:
        event = {"event": "progress", "stage": "evaluate", "phase": "calibrating surprise"}
        display.report(event | {"step": episodes, "steps": 2 * ood_score.EPISODES})

    return calibrated(load_checkpoint(checkpoint_file(what)), progress)


def save_calibrated(folder: Path, display: Display) -> None:
    """Calibrate the newest checkpoint of a run; the file is written only if it was not calibrated before."""
    calibrated = calibrate(folder, display)
    file = checkpoint_file(folder)
    if calibrated.part("outcomes") and not load_checkpoint(file).part("outcomes"):
        save_checkpoint(file, calibrated)


def report_name(run: Run, what: Path, suite: str = "online", deploy: Deployment | None = None) -> str:
    """File name of a report without its suffix.  It holds the suite, the agent and the settings, so no two share a name.

    Example: ``online-T2-1a2b3c4d-paper-uniform-p0_0.2-40episodes-2seeds`` for T^2, with the first digits of
    its weights digest.  The report of a checkpoint file begins with the name of that file; a long list of
    strengths p is replaced by its SHA-256.
    """
    manifest = load_checkpoint(checkpoint_file(what)).manifest
    settings = run.evaluate
    levels = "_".join(repr(float(p)).removesuffix(".0") for p in settings.p)
    if len(levels) > 60:
        levels = hashlib.sha256(levels.encode()).hexdigest()[:16]
    agent = f"T{manifest['version']}-{str(manifest.get('weights_digest', ''))[:8]}"
    rule = deploy or methods.of(run).deployment(run)
    prefix = "" if what.is_dir() else f"{what.stem[:60]}-"
    return f"{suite}-{prefix}{agent}-{rule}-{settings.prior}-p{levels}-{settings.episodes}episodes-{settings.seeds}seeds"


def online(
    run: Run, what: Path, display: Display, deploy: Deployment | None = None
) -> tuple[list[evaluate.Result], dict[str, Any]]:
    """Online returns of the folder's models, the newest first, and of the problem's references.

    Models are deployed by ``deploy``; None: by the rule that they were trained for.  If that rule is not
    Algorithm 1, the newest model is deployed by Algorithm 1 as well.  The second result is the OOD score
    of the newest model after the last episode, by p; empty if it was not calibrated.
    """
    check_suite(run, "online")
    found, problem = models(what), registry.of(run)
    policies = {name: evaluate.in_context(model, run.context, deploy) for name, model in found.items()}
    newest, model = next(iter(found.items()))
    scores: list[Surprise] = []
    if outcomes := outcomes_of(load_checkpoint(checkpoint_file(what))):

        def scored(rows: Sequence[Variation], env: Batch) -> Policy:
            scores.append(Surprise(outcomes, model.spec, len(rows)))
            return model.method.policy(model.model, len(rows), run.context, deploy, scores[-1].observe)

        policies[newest] = scored
    if (deploy or model.method.deployment(run)) != "paper":
        policies[f"{newest}, Algorithm 1"] = evaluate.in_context(model, run.context, "paper")
    agents: dict[str, MakePolicy | Reference] = {**policies, **problem.references(run)}
    if missing := problem.missing_reference(run, str(what / "run.toml") if what.is_dir() else "RUN"):
        display.report({"event": "note", "text": missing})
    results = evaluate.online(run, agents, _count(display, "held-out evaluation", run, len(agents)))
    return results, {f"{p:g}": _spread(one.score()) for p, one in zip(run.evaluate.p, scores, strict=False)}


def _spread(values: Float[np.ndarray, " B"]) -> dict[str, float]:
    return {"median": round(float(np.median(values)), 2), "above_1": round(float((values > 1).mean()), 4)}


def check_suite(run: Run, suite: str) -> None:
    """Raises ConfigError if the run's problem or method does not support the suite."""
    problem, method = registry.of(run), methods.of(run)
    if not problem.evaluated:
        raise ConfigError(f"--suite {suite}: {run.problem} has no tasks to evaluate on: change [{problem.section}]")
    if suite == "offline" and not evaluate.sources(run):
        lacks = "has no reference 'random' and none that is given the task"
        raise ConfigError(f"--suite offline: {run.problem} {lacks}, so nothing collects data; use --suite online")
    if suite == "posterior" and (problem.posterior is None or type(method).distributions is Method.distributions):
        raise ConfigError(f"--suite posterior: {run.problem} with {run.method} has no exact posterior; use --suite online")
    if suite == "posterior" and problem.exact is None:
        raise ConfigError(f"--suite posterior: {run.problem} has no exact answers; use --suite online")


def offline(run: Run, what: Path, deploy: Deployment | None = None) -> list[evaluate.Result]:
    """Offline returns of the folder's models and of references, given random and expert data."""
    return evaluate.offline(run, models(what), deploy)


def show_online(
    run: Run, report: Path, results: list[evaluate.Result], scores: dict[str, Any], console: Console
) -> dict[str, Any]:
    """Print the table; write the rows to ``report``.json and the figure to ``report``.png.  Returns both, and summaries."""
    rows = [result.row() for result in results]
    adapted = _adaptation(results)
    title = f"{run.method.upper()} on {registry.of(run).title(len(results[0].returns))}, {run.evaluate.seeds} seeds"
    atomic_write(report.with_name(f"{report.name}.json"), lambda file: file.write(json.dumps(rows, indent=1).encode()))
    figure = plots.adaptation(rows, report.with_name(f"{report.name}.png"), title)
    console.print(returns_table(results, f"Return by online episode: {title}"))
    _show_broken(results, console)
    for p, score in scores.items():
        text = f"surprise at the end, p = {p}: median {score['median']:.2f}, above 1 in {score['above_1']:.0%}"
        console.print(text, highlight=False, markup=False)
    console.print(f"figure {figure}", highlight=False, markup=False)
    return {**adapted, "surprise": scores, "rows": rows, "figure": str(figure)}


def _show_broken(results: list[evaluate.Result], console: Console) -> None:
    for one in results:
        if one.broken:
            text = f"{one.agent}, p = {one.p:g}: the simulation diverged in {one.broken} of {one.returns.size} episodes; "
            console.print(text + "their return up to that step counts", highlight=False, markup=False)


def _adaptation(results: list[evaluate.Result]) -> dict[str, dict[str, float | int | None]]:
    """How fast the newest model adapts, by p: ``Result.first_over`` and ``Result.episode_of`` relative to the oracle."""
    oracle = {result.p: result for result in results if result.ceiling and result.optimum is not None}
    if not oracle:
        return {}
    newest = [result for result in results if result.agent == results[0].agent]
    return {
        "first10_over_oracle": {f"{one.p:g}": one.first_over(oracle[one.p], 10) for one in newest},
        "episode_of_90": {f"{one.p:g}": one.episode_of(oracle[one.p], 0.9) for one in newest},
    }


def show_experts(folder: Path, console: Console) -> dict[str, Any]:
    """Print the returns of the first and the last recorded episode of each expert; returns the rows."""
    data = Dataset(folder / "dataset", readonly=True)
    rows = []
    for key in data.variations("pretrain", 0):
        trials = data.trials(key)
        params = {name: round(value, 4) for name, value in trials[0].variation.task.params if isinstance(value, float)}
        kind, ends = trials[0].variation.adversary.kind, (trials[0], trials[-1])
        rows.append({"task": params, "adversary": kind, "returns": [round(trial.episode_return, 2) for trial in ends]})
    data.close()
    console.print(experts_table(rows))
    return {"experts": rows}


def posterior(run: Run, what: Path, display: Display) -> dict[str, Any]:
    """Comparison of the newest model with the exact posterior, on training and on held-out tasks."""
    model = trained(load_checkpoint(checkpoint_file(what)))
    suite = registry.of(run).posterior
    assert suite is not None, "``check_suite`` refuses problems without one"

    def decide(
        transitions: Sequence[np.ndarray], queries: Float32[np.ndarray, "B N S"], prefix: Int64[np.ndarray, "B N"]
    ) -> Float64[np.ndarray, "B N A"]:
        probs = model.method.distributions(model.model, transitions, queries, prefix)
        if probs is None:
            raise ConfigError(f"--suite posterior: the model of {run.method} gives no distributions; use --suite online")
        return probs

    act = evaluate.in_context(model, run.context, "paper")
    report: dict[str, Any] = {}
    total = len(suite.kinds) * len(suite.levels(run))
    for name, heldout in (("kl_nats", False), ("kl_heldout", True)):
        event = {"event": "progress", "stage": "evaluate", "phase": f"contexts, {_goals(heldout)}", "steps": total}
        found = []
        for pair in suite.divergences(run, decide, act, heldout):
            found.append(pair)
            display.report(event | {"step": len(found)})
        for prior, ones in zip(suite.priors, zip(*found, strict=True), strict=True):
            report |= {f"{name}{prior}{part}": value for part, value in suite.summary(ones).items()}
            report[f"{name}{prior}_curves"] = suite.curves(ones)
    split = registry.of(run).split
    for name, heldout in (("paper_gap", True), ("paper_gap_train", False)):
        tasks = split.test if heldout else split.train[: len(split.test)]
        progress = _count(display, f"online, {_goals(heldout)}", run, 2)
        report[name] = posterior_suite.gaps(run, act, tasks, progress)
    return report


def show_posterior(run: Run, report: Path, found: dict[str, Any], console: Console) -> dict[str, Any]:
    """Print the tables; write ``report``.json and the figure ``report``.png.  Returns the report without its curves."""
    problem = registry.of(run)
    title = f"{run.method.upper()} compared with the exact posterior: {problem.title(len(problem.evaluated))}"
    atomic_write(report.with_name(f"{report.name}.json"), lambda file: file.write(json.dumps(found, indent=1).encode()))
    figure = plots.agreement(found, report.with_name(f"{report.name}.png"), title)
    assert problem.posterior is not None, "``check_suite`` refuses problems without one"
    for prior, meaning in problem.posterior.priors.items():
        console.print(kl_table(found, prior, f"KL(exact || model) in nats, where {meaning}"))
    adversary = f"{run.evaluate.prior} adversary, {run.evaluate.episodes} episodes, {run.evaluate.seeds} seeds"
    console.print(gap_table(found, f"Online return by Algorithm 1 compared with the exact agent's: {adversary}"))
    console.print(f"figure {figure}", highlight=False, markup=False)
    return {key: value for key, value in found.items() if not key.endswith("_curves")} | {"figure": str(figure)}


def _goals(heldout: bool) -> str:
    return f"{'held-out' if heldout else 'training'} goals"


def _count(display: Display, phase: str, run: Run, agents: int) -> Callable[[str, float, int], None]:
    """A progress callback that displays every episode of every agent at every p as one step."""
    total, done = agents * len(run.evaluate.p) * run.evaluate.episodes, 0

    def progress(agent: str, p: float, episodes: int) -> None:
        nonlocal done
        done += 1
        display.report({"event": "progress", "stage": "evaluate", "phase": phase, "step": done, "steps": total})

    return progress


def show_offline(run: Run, results: list[evaluate.Result], console: Console) -> dict[str, Any]:
    """Print the table; returns the rows."""
    title = registry.of(run).title(len(results[0].returns))
    console.print(returns_table(results, f"One episode given data collected before: {title}"))
    _show_broken(results, console)
    return {"rows": [result.row() for result in results]}
