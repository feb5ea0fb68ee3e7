"""A run folder's agents on held-out tasks: who is compared, and what is kept of it."""

from __future__ import annotations

import functools
import hashlib
import json
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float
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
    """The newest model and, in a run folder, the T^0 that it grew from."""
    newest = load_checkpoint(checkpoint_file(what))
    version = newest.manifest["version"]
    found = {f"T^{version} ({newest.manifest['method']})": trained(newest)}
    if what.is_dir() and version > 0:
        found["T^0"] = trained(load_checkpoint(checkpoint_file(what, 0)))
    return found


def calibrate(what: Path, display: Display) -> Checkpoint:
    """The newest checkpoint with what its model expects to happen, which is learned now if it was not before."""

    def progress(episodes: int) -> None:
        event = {"event": "progress", "stage": "evaluate", "phase": "calibrating surprise"}
        display.report(event | {"step": episodes, "steps": 2 * ood_score.EPISODES})

    return calibrated(load_checkpoint(checkpoint_file(what)), progress)


def keep_calibrated(folder: Path, display: Display) -> None:
    """Calibrate a run's newest checkpoint, which is written anew only if it was not calibrated before."""
    made = calibrate(folder, display)
    file = checkpoint_file(folder)
    if made.part("outcomes") and not load_checkpoint(file).part("outcomes"):
        save_checkpoint(file, made)


def report_name(run: Run, what: Path, suite: str = "online", deploy: Deployment | None = None) -> str:
    """The name of a report, without its ending: the suite, the agent and the settings, so that other settings have another.

    Such as ``online-T2-1a2b3c4d-paper-uniform-p0_0.2-40episodes-2seeds``: T^2, whose weights have that
    digest.  A checkpoint file's own name comes before; more than ten probabilities are named by a digest.
    """
    manifest = load_checkpoint(checkpoint_file(what)).manifest
    settings = run.evaluate
    levels = "_".join(repr(float(p)).removesuffix(".0") for p in settings.p)
    if len(levels) > 60:
        levels = hashlib.sha256(levels.encode()).hexdigest()[:16]
    agent = f"T{manifest['version']}-{str(manifest.get('weights_digest', ''))[:8]}"
    by = deploy or methods.of(run).deployment(run)
    named = "" if what.is_dir() else f"{what.stem[:60]}-"
    return f"{suite}-{named}{agent}-{by}-{settings.prior}-p{levels}-{settings.episodes}episodes-{settings.seeds}seeds"


def online(
    run: Run, what: Path, display: Display, deploy: Deployment | None = None
) -> tuple[list[evaluate.Result], dict[str, Any]]:
    """Online returns of the folder's models, a random policy, the exact agents and the oracle; the newest model first.

    In a continuous game experts stand in for the exact agents, where there are any on this machine.

    Deployed by ``deploy``, or by the better rule that they were trained for; if that is not
    Algorithm 1, the newest is deployed by it too.  And the newest's surprise at the end, by p,
    if it was calibrated.
    """
    found, problem = models(what), registry.of(run)
    made = {name: evaluate.in_context(model, deploy) for name, model in found.items()}
    newest, model = next(iter(found.items()))
    scores: list[Surprise] = []
    if outcomes := outcomes_of(load_checkpoint(checkpoint_file(what))):

        def scored(rows: Sequence[Variation], env: Batch) -> Policy:
            scores.append(Surprise(outcomes, model.spec, len(rows)))
            return model.method.policy(model.model, len(rows), run.context, deploy, scores[-1].observe)

        made[newest] = scored
    if (deploy or model.method.deployment(run)) != "paper":
        made[f"{newest}, Algorithm 1"] = evaluate.in_context(model, "paper")
    agents: dict[str, MakePolicy | Reference] = {**made, **problem.references(run)}
    if missing := problem.missing_reference(run, str(what / "run.toml") if what.is_dir() else "RUN"):
        display.report({"event": "note", "text": missing})
    results = evaluate.online(run, agents, _count(display, "held-out evaluation", run, len(agents)))
    return results, {f"{p:g}": _spread(one.now()) for p, one in zip(run.evaluate.p, scores, strict=False)}


def _spread(values: Float[np.ndarray, " B"]) -> dict[str, float]:
    return {"median": round(float(np.median(values)), 2), "above_1": round(float((values > 1).mean()), 4)}


def check_suite(run: Run, suite: str) -> None:
    """Raises ConfigError if the run's problem or method lacks a part that the suite needs."""
    problem, method = registry.of(run), methods.of(run)
    if suite == "offline" and problem.exact is None:
        raise ConfigError(f"--suite offline: {run.problem} has no exact answers for expert data; use --suite online")
    if suite == "posterior" and (problem.posterior is None or type(method).distributions is Method.distributions):
        raise ConfigError(f"--suite posterior: {run.problem} with {run.method} has no exact posterior; use --suite online")


def offline(run: Run, what: Path, deploy: Deployment | None = None) -> list[evaluate.Result]:
    """Offline returns of the folder's models, given random and expert data."""
    return evaluate.offline(run, models(what), deploy)


def show_online(
    run: Run, report: Path, results: list[evaluate.Result], surprised: dict[str, Any], console: Console
) -> dict[str, Any]:
    """Print the table, keep the rows as ``report``.json and the figure as ``report``.png; returns the rows with its path."""
    rows = [result.row() for result in results]
    adapted = _adaptation(results)
    title = f"{run.method.upper()} on {registry.of(run).title(len(results[0].returns))}, {run.evaluate.seeds} seeds"
    atomic_write(report.with_name(f"{report.name}.json"), lambda file: file.write(json.dumps(rows, indent=1).encode()))
    figure = plots.adaptation(rows, report.with_name(f"{report.name}.png"), title)
    console.print(returns_table(results, f"Return by online episode: {title}"))
    for one in results:
        if one.broken:
            told = f"{one.agent}, p = {one.p:g}: the simulation broke down in {one.broken} of {one.returns.size} episodes; "
            console.print(told + "they count with what they had earned by then", highlight=False, markup=False)
    for p, one in surprised.items():
        told = f"surprise at the end, p = {p}: median {one['median']:.2f}, above 1 in {one['above_1']:.0%}"
        console.print(told, highlight=False, markup=False)
    console.print(f"figure {figure}", highlight=False, markup=False)
    return {**adapted, "surprise": surprised, "rows": rows, "figure": str(figure)}


def _adaptation(results: list[evaluate.Result]) -> dict[str, dict[str, float | int | None]]:
    """How soon the newest model acts well, by p, beside the oracle: see ``Result.first_over`` and ``Result.episode_of``."""
    oracle = {result.p: result for result in results if result.ceiling and result.optimum is not None}
    if not oracle:
        return {}
    newest = [result for result in results if result.agent == results[0].agent]
    return {
        "first10_over_oracle": {f"{one.p:g}": one.first_over(oracle[one.p], 10) for one in newest},
        "episode_of_90": {f"{one.p:g}": one.episode_of(oracle[one.p], 0.9) for one in newest},
    }


def show_experts(folder: Path, console: Console) -> dict[str, Any]:
    """Print what each expert's first and last recorded episode returned; returns the rows."""
    data = Dataset(folder / "dataset", readonly=True)
    rows = []
    for key in data.variations("pretrain", 0):
        trials = data.trials(key)
        told = {name: round(value, 4) for name, value in trials[0].variation.task.params if isinstance(value, float)}
        kind, ends = trials[0].variation.adversary.kind, (trials[0], trials[-1])
        rows.append({"task": told, "adversary": kind, "returns": [round(trial.episode_return, 2) for trial in ends]})
    data.close()
    console.print(experts_table(rows))
    return {"experts": rows}


def posterior(run: Run, what: Path, display: Display) -> dict[str, Any]:
    """The newest model beside the exact posterior, on training and on held-out tasks."""
    model = trained(load_checkpoint(checkpoint_file(what)))
    suite = registry.of(run).posterior
    decide = functools.partial(model.method.distributions, model.model)
    act = evaluate.in_context(model, "paper")
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
        report[name] = posterior_suite.gaps(run, evaluate.in_context(model), tasks, progress)
    return report


def show_posterior(run: Run, report: Path, found: dict[str, Any], console: Console) -> dict[str, Any]:
    """Print the tables, keep everything as ``report``.json and the figure as ``report``.png; returns all but the curves."""
    problem = registry.of(run)
    title = f"{run.method.upper()} beside the exact posterior: {problem.title(len(problem.evaluated))}"
    atomic_write(report.with_name(f"{report.name}.json"), lambda file: file.write(json.dumps(found, indent=1).encode()))
    figure = plots.agreement(found, report.with_name(f"{report.name}.png"), title)
    for prior, meaning in problem.posterior.priors.items():
        console.print(kl_table(found, prior, f"KL(exact || model) in nats, where {meaning}"))
    adversary = f"{run.evaluate.prior} adversary, {run.evaluate.episodes} episodes, {run.evaluate.seeds} seeds"
    console.print(gap_table(found, f"Online return by Algorithm 1 beside the exact agent's: {adversary}"))
    console.print(f"figure {figure}", highlight=False, markup=False)
    return {key: value for key, value in found.items() if not key.endswith("_curves")} | {"figure": str(figure)}


def _goals(heldout: bool) -> str:
    return f"{'held-out' if heldout else 'training'} goals"


def _count(display: Display, phase: str, run: Run, agents: int) -> Callable[[str, float, int], None]:
    """Shows every episode of ``agents`` at every p as one step."""
    total, done = agents * len(run.evaluate.p) * run.evaluate.episodes, 0

    def progress(agent: str, p: float, episodes: int) -> None:
        nonlocal done
        done += 1
        display.report({"event": "progress", "stage": "evaluate", "phase": phase, "step": done, "steps": total})

    return progress


def show_offline(results: list[evaluate.Result], console: Console) -> dict[str, Any]:
    """Print the table; returns the rows."""
    console.print(returns_table(results, "One episode given data collected before, on goals never trained on"))
    return {"rows": [result.row() for result in results]}
