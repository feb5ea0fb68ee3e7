"""A run folder's agents on held-out tasks: who is compared, and what is kept of it."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float
from rich.console import Console

from icrl_dist.agent import ood_score
from icrl_dist.agent.in_context_agent import calibrated, checkpoint_file, model_of, outcomes_of
from icrl_dist.agent.ood_score import Surprise
from icrl_dist.config.run import Deployment, Run, default_deployment
from icrl_dist.console.terminal import Display, experts_table, gap_table, kl_table, returns_table
from icrl_dist.experts import cache
from icrl_dist.models.dpt import PretrainedTransformer
from icrl_dist.problems import splits
from icrl_dist.problems.darkroom import divergence
from icrl_dist.problems.darkroom.exact_agents import RULES
from icrl_dist.results import evaluate, plots
from icrl_dist.rollout import deployment
from icrl_dist.storage.checkpoint import Checkpoint, load_checkpoint, save_checkpoint
from icrl_dist.storage.dataset import Dataset
from icrl_dist.storage.files import atomic_write
from icrl_dist.types import Variation


def models(what: Path) -> dict[str, PretrainedTransformer]:
    """The newest model and, in a run folder, the T^0 that it grew from."""
    newest = load_checkpoint(checkpoint_file(what))
    version = newest.manifest["version"]
    found = {f"T^{version} ({newest.manifest['method']})": model_of(newest)[0]}
    if what.is_dir() and version > 0:
        found["T^0"] = model_of(load_checkpoint(checkpoint_file(what, 0)))[0]
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
    if not load_checkpoint(file).part("outcomes"):
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
    by = deploy or default_deployment(run.model)
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
    found = models(what)
    agents: dict[str, evaluate.MakePolicy] = {name: evaluate.in_context(run, model, deploy) for name, model in found.items()}
    newest, model = next(iter(found.items()))
    watches: list[Surprise] = []
    if outcomes := outcomes_of(load_checkpoint(checkpoint_file(what))):

        def watched(rows: Sequence[Variation]) -> deployment.Policy:
            watches.append(Surprise(outcomes, model.spec, len(rows)))
            return deployment.in_context(model, len(rows), run.context, deploy, watches[-1].observe)

        agents[newest] = watched
    if (deploy or default_deployment(run.model)) != "paper":
        agents[f"{newest}, Algorithm 1"] = evaluate.in_context(run, model, "paper")
    others = _others(run)
    agents |= others
    if run.problem.startswith("dmc-") and evaluate.EXPERT not in others:
        display.report({"event": "note", "text": _no_expert(run, what)})
    results = evaluate.online(run, agents, _count(display, "held-out evaluation", run, len(agents)))
    return results, {f"{p:g}": _spread(one.now()) for p, one in zip(run.evaluate.p, watches, strict=False)}


def _others(run: Run) -> dict[str, evaluate.MakePolicy]:
    """Who the models stand beside."""
    if run.problem == "darkroom":
        agents: dict[str, evaluate.MakePolicy] = {"random": evaluate.random}
        agents |= {name: evaluate.exact(run, rule) for rule, name in RULES.items()}
        return agents | {evaluate.ORACLE: evaluate.optimal(run)}
    agents = {"random": evaluate.random_vectors}
    if run.problem.startswith("metaworld"):
        return agents | {evaluate.SCRIPTED: evaluate.scripted}
    trained = evaluate.expert(run, splits.evaluated(run))
    return agents if trained is None else agents | {evaluate.EXPERT: trained}


def _no_expert(run: Run, what: Path) -> str:
    """Why no expert stands beside the models, and what would put it there."""
    if not run.sac.cache:
        return "no SAC expert stands beside the models: with sac.cache = '' none is kept"
    missing = [task for task in splits.evaluated(run) if cache.any_kept(Variation(task), run.sac, run.seed) is None]
    train = f"icrl-dist train experts-{what / 'run.toml' if what.is_dir() else 'RUN'} --out OTHER"
    where = f"{len(missing)} of the evaluated tasks have none in {run.sac.cache} on this machine"
    return f"no SAC expert stands beside the models: {where}; `{train}` trains them"


def _spread(values: Float[np.ndarray, " B"]) -> dict[str, float]:
    return {"median": round(float(np.median(values)), 2), "above_1": round(float((values > 1).mean()), 4)}


def offline(run: Run, what: Path, deploy: Deployment | None = None) -> list[evaluate.Result]:
    """Offline returns of the folder's models, given random and expert data."""
    return evaluate.offline(run, models(what), deploy)


def show_online(
    run: Run, report: Path, results: list[evaluate.Result], surprised: dict[str, Any], console: Console
) -> dict[str, Any]:
    """Print the table, keep the rows as ``report``.json and the figure as ``report``.png; returns the rows with its path."""
    rows = [result.row() for result in results]
    adapted = _adaptation(results)
    title = f"{run.method.upper()} on {_tasks(run, len(results[0].returns))}, {run.evaluate.seeds} seeds"
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
    oracle = {result.p: result for result in results if result.agent == evaluate.ORACLE}
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


def _tasks(run: Run, count: int) -> str:
    if run.problem == "darkroom":
        return f"{count} held-out goals of a {run.darkroom.size}x{run.darkroom.size} Dark Room"
    return f"{count} {'training' if run.problem.startswith('dmc-') else 'held-out'} tasks of {run.problem}"


def posterior(run: Run, what: Path, display: Display) -> dict[str, Any]:
    """The newest model beside the exact posterior: ``truth``'s measures on training and on held-out goals."""
    model = model_of(load_checkpoint(checkpoint_file(what)))[0]
    report: dict[str, Any] = {}
    total = len(divergence.KINDS) * len(divergence.levels(run))
    for name, heldout in (("kl_nats", False), ("kl_heldout", True)):
        event = {"event": "progress", "stage": "evaluate", "phase": f"contexts, {_goals(heldout)}", "steps": total}
        found = []
        for pair in divergence.divergences(run, model, heldout):
            found.append(pair)
            display.report(event | {"step": len(found)})
        for law, ones in zip(divergence.LAWS, zip(*found, strict=True), strict=True):
            summary = divergence.summary(ones)
            report |= {f"{name}{law}{part}": value for part, value in summary.items()}
            report[f"{name}{law}_curves"] = divergence.curves(ones)
    split = splits.split(run)
    for name, heldout in (("paper_gap", True), ("paper_gap_train", False)):
        goals = split.test if heldout else split.train[: len(split.test)]
        progress = _count(display, f"online, {_goals(heldout)}", run, 2)
        report[name] = divergence.gaps(run, evaluate.in_context(run, model), goals, progress)
    return report


def show_posterior(run: Run, report: Path, found: dict[str, Any], console: Console) -> dict[str, Any]:
    """Print the tables, keep everything as ``report``.json and the figure as ``report``.png; returns all but the curves."""
    size = run.darkroom.size
    title = f"{run.method.upper()} beside the exact posterior in a {size}x{size} Dark Room"
    atomic_write(report.with_name(f"{report.name}.json"), lambda file: file.write(json.dumps(found, indent=1).encode()))
    figure = plots.agreement(found, report.with_name(f"{report.name}.png"), title)
    for law, meaning in divergence.LAWS.items():
        console.print(kl_table(found, law, f"KL(exact || model) in nats, where {meaning}"))
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
