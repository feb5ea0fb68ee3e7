"""Evaluation of a run folder's models on held-out tasks, compared with references, as result rows."""

from __future__ import annotations

import hashlib
import os
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from jaxtyping import Float32, Float64, Int64

from icrl_dist.agent import ood_score
from icrl_dist.agent.loading import calibrated, checkpoint_file, open_checkpoint, outcomes_of, trained
from icrl_dist.agent.ood_score import Surprise
from icrl_dist.agent.trained_model import TrainedModel
from icrl_dist.config.run import ConfigError, Deployment, Run
from icrl_dist.console.display import ReportEvent
from icrl_dist.interfaces import Batch, MakePolicy, Method, Policy, Reference
from icrl_dist.methods import registry as methods
from icrl_dist.problems import registry
from icrl_dist.results import attack as attack_suite
from icrl_dist.results import evaluate, rows, training_rows
from icrl_dist.results import posterior as posterior_suite
from icrl_dist.results import worst as worst_suite
from icrl_dist.results.evaluate import Agent
from icrl_dist.results.names import key_of
from icrl_dist.storage.checkpoint import Checkpoint, save_checkpoint
from icrl_dist.storage.dataset import Dataset
from icrl_dist.storage.files import StoreError
from icrl_dist.stream.schema import as_data
from icrl_dist.types import Variation

if TYPE_CHECKING:
    import pandas as pd


def models(what: Path, deploy: Deployment | None = None) -> dict[Agent, TrainedModel]:
    """The newest model and, in a run folder with adapted versions, T^0, each with the rule that deploys it."""
    found = [open_checkpoint(what)]
    if what.is_dir() and found[0].manifest["version"] > 0:
        found.append(open_checkpoint(what, 0))
    return dict(_agent(checkpoint, deploy) for checkpoint in found)


def _agent(checkpoint: Checkpoint, deploy: Deployment | None = None) -> tuple[Agent, TrainedModel]:
    model, version = trained(checkpoint), int(checkpoint.manifest["version"])
    rule = deploy or model.method.deployment(model.run)
    return Agent(key_of(version), rule, version, str(checkpoint.manifest.get("weights_digest", ""))), model


def calibrate(what: Path, report: ReportEvent) -> Checkpoint:
    """The newest checkpoint with its outcome readout, which is fitted now if it is missing."""

    def progress(episodes: int) -> None:
        event = {"event": "progress", "stage": "evaluate", "phase": "calibrating surprise"}
        report(event | {"step": episodes, "steps": 2 * ood_score.EPISODES})

    return calibrated(open_checkpoint(what), progress)


def save_calibrated(folder: Path, report: ReportEvent) -> None:
    """Calibrate the newest checkpoint of a run; the file is written only if it was not calibrated before."""
    calibrated = calibrate(folder, report)
    file = checkpoint_file(folder)
    if calibrated.part("outcomes") and not open_checkpoint(folder).part("outcomes"):
        save_checkpoint(file, calibrated)


def report_name(run: Run, what: Path, suite: str = "online", deploy: Deployment | None = None) -> str:
    """File name of a report without its suffix.  It holds the suite, the agent and the settings, so no two share a name.

    Example: ``online-T2-1a2b3c4d-paper-uniform-p0_0.2-40episodes-2seeds`` for T^2, with the first digits of
    its weights digest.  The report of a checkpoint file begins with the name of that file; a long list of
    strengths p is replaced by its SHA-256.
    """
    manifest = open_checkpoint(what).manifest
    settings = run.evaluate
    levels = "_".join(repr(float(p)).removesuffix(".0") for p in settings.p)
    if len(levels) > 60:
        levels = hashlib.sha256(levels.encode()).hexdigest()[:16]
    agent = f"T{manifest['version']}-{str(manifest.get('weights_digest', ''))[:8]}"
    rule = deploy or methods.of(run).deployment(run)
    prefix = "" if what.is_dir() else f"{what.stem[:60]}-"
    return f"{suite}-{prefix}{agent}-{rule}-{settings.prior}-p{levels}-{settings.episodes}episodes-{settings.seeds}seeds"


def online(
    run: Run,
    what: Path,
    results: Path,
    report: ReportEvent,
    deploy: Deployment | None = None,
    unstored: list[StoreError] | None = None,
    with_references: bool = True,
) -> pd.DataFrame:
    """Online returns of the folder's models, the newest first, and of the problem's references, as result rows.

    The rows are written to the folder ``results``; ``unstored`` as in ``rows.record``.  Models are deployed by
    ``deploy``; None: by the rule that they were trained for.  If that rule is not Algorithm 1, the newest model is
    deployed by Algorithm 1 as well.  Rows of the newest model have the OOD score after the last episode if it was
    calibrated.  ``with_references``: False leaves the references out (``references`` evaluates them alone).
    """
    check_suite(run, "online")
    found, problem = models(what, deploy), registry.of(run)
    agents = _deployed(run, found, deploy)
    newest, model = next(iter(found.items()))
    scores: list[Surprise] = []
    if outcomes := outcomes_of(open_checkpoint(what)):

        def scored(rows: Sequence[Variation], env: Batch) -> Policy:
            scores.append(Surprise(outcomes, model.spec, len(rows)))
            return model.method.policy(model.model, len(rows), run.context, deploy, scores[-1].observe)

        agents[newest] = scored
    if with_references:
        agents |= _references(run)
        if missing := problem.missing_reference(run, str(what / "run.toml") if what.is_dir() else "RUN"):
            report({"event": "note", "text": missing})
    evaluated = evaluate.online(run, agents, _count(report, "held-out evaluation", run, len(agents)))
    for one, score in zip((one for one in evaluated if one.agent == newest), scores, strict=False):
        column = np.full(one.returns.shape, np.nan)
        column[:, :, -1] = score.score().reshape(column.shape[:2])
        one.extra["surprise"] = column
    return _recorded(run, what, results, "online", {"evaluated": evaluated}, deploy, unstored)


def _deployed(run: Run, found: Mapping[Agent, TrainedModel], deploy: Deployment | None) -> dict[Agent, MakePolicy | Reference]:
    """The models by their rule, and if that is not Algorithm 1, the newest one by Algorithm 1 as well."""
    agents: dict[Agent, MakePolicy | Reference] = {
        agent: evaluate.in_context(model, run.context, deploy) for agent, model in found.items()
    }
    newest, model = next(iter(found.items()))
    if newest.deployment != "paper":
        agents[newest._replace(deployment="paper")] = evaluate.in_context(model, run.context, "paper")
    return agents


def _references(run: Run) -> dict[Agent, Reference]:
    return {Agent(key): reference for key, reference in registry.of(run).references(run).items()}


def references(
    run: Run,
    suite: Literal["online", "offline"],
    results: Path,
    name: str,
    report: ReportEvent,
    unstored: list[StoreError] | None = None,
) -> pd.DataFrame:
    """Returns of the problem's references alone as result rows of this suite: a run without a model has them too.

    ``name``: the run's name in the rows, which are written to the folder ``results``.  The draws are those of ``online`` and
    ``offline``, so the rows are partners of those of models that were evaluated with the same seed and settings.
    """
    check_suite(run, suite)
    if suite == "online":
        agents = _references(run)
        found = evaluate.online(run, agents, _count(report, "reference agents", run, len(agents)))
    else:
        found = evaluate.offline(run, {})
    settings = {"references": as_data(run.evaluate)}
    return rows.record(results, suite, settings, [one.block(run, name, "evaluated") for one in found], unstored)


def attack(
    run: Run,
    what: Path,
    results: Path,
    report: ReportEvent,
    draws: int,
    deploy: Deployment | None = None,
    unstored: list[StoreError] | None = None,
    with_references: bool = True,
) -> pd.DataFrame:
    """The rows of suite ``attack`` (``results.attack``) of the folder's models and of references; see ``online``."""
    agents = _deployed(run, models(what, deploy), deploy)
    if with_references:
        agents |= _references(run)
    progress = _count(report, "attacked episodes", run, len(agents))
    settings = f"{report_name(run, what, 'attack', deploy)}-{draws}draws"
    return rows.record(results, "attack", settings, attack_suite.blocks(run, agents, draws, name_of(what), progress), unstored)


def worst(
    run: Run,
    what: Path,
    results: Path,
    report: ReportEvent,
    adversaries: int,
    steps: int,
    unstored: list[StoreError] | None = None,
    with_references: bool = True,
) -> pd.DataFrame:
    """The rows of suite ``worst`` (``results.worst``) of the folder's models, by Algorithm 1, and of references.

    ``unstored`` as in ``rows.record``.  References are those that tables have, without the random policy.
    """
    agents = _deployed(run, models(what, "paper"), "paper")
    if with_references:
        agents |= {agent: reference for agent, reference in _references(run).items() if agent.key != "random"}
    total = len(agents) * len(run.evaluate.p)
    order = [(agent.key, p) for agent in agents for p in run.evaluate.p]

    def progress(agent: str, p: float, done: int) -> None:
        step = order.index((agent, p)) * steps + done
        report(
            {"event": "progress", "stage": "evaluate", "phase": "steps of adversaries", "step": step, "steps": total * steps}
        )

    settings = f"{report_name(run, what, 'worst', 'paper')}-{adversaries}adversaries-{steps}steps"
    made = worst_suite.blocks(run, agents, adversaries, steps, name_of(what), progress)
    return rows.record(results, "worst", settings, made, unstored)


def _recorded(
    run: Run,
    what: Path,
    results: Path,
    suite: str,
    found: Mapping[str, Sequence[evaluate.Result]],
    deploy: Deployment | None,
    unstored: list[StoreError] | None,
) -> pd.DataFrame:
    """Write the results, by the tasks that they are of, as result rows to ``results``; returns the rows."""
    blocks = [one.block(run, name_of(what), tasks) for tasks, ones in found.items() for one in ones]
    return rows.record(results, suite, report_name(run, what, suite, deploy), blocks, unstored)


def name_of(what: Path) -> str:
    """The name of the run in result rows: that of its folder, or of the checkpoint file."""
    folder = run_folder(what)
    return named(what.stem if folder is None else folder.resolve().name)


def named(name: str) -> str:
    """The name of a file or folder as text: bytes that are no UTF-8 become escapes, such as ``run\\xff``."""
    return os.fsencode(name).decode(errors="backslashreplace")


def run_folder(what: Path) -> Path | None:
    """The run folder that a run folder or a checkpoint file belongs to; None for a file outside of one."""
    if what.is_dir():
        return what
    beside = what.absolute().parent
    folder = beside.parent if beside.name == "checkpoints" else beside
    return folder if (folder / "run.toml").exists() else None


def check_suite(run: Run, suite: str) -> None:
    """Raises ConfigError if the run's problem or method does not support the suite."""
    problem, method = registry.of(run), methods.of(run)
    if suite == "offline" and not evaluate.sources(run):
        lacks = "has no reference 'random' and none that is given the task"
        raise ConfigError(f"--suite offline: {run.problem} {lacks}, so nothing collects data; use --suite online")
    if suite == "attack" and problem.certify is None:
        raise ConfigError(
            f"--suite attack: {run.problem} with these adversaries has no exact worst case; use --suite online --prior unseen"
        )
    if suite == "attack" and min(run.evaluate.p) <= 0:
        raise ConfigError("--suite attack: at p = 0 there is no adversary; name strengths above 0, as in --p 0.2 0.4")
    if suite == "worst" and problem.second_player is None:
        raise ConfigError(
            f"--suite worst: {run.problem} has no second player that can be trained as adversary; use --suite online --p 1"
        )
    if suite == "worst" and min(run.evaluate.p) <= 0:
        raise ConfigError("--suite worst: at p = 0 there is no adversary; name strengths above 0, as in --p 0.5 1")
    if suite == "posterior" and (problem.posterior is None or type(method).distributions is Method.distributions):
        raise ConfigError(f"--suite posterior: {run.problem} with {run.method} has no exact posterior; use --suite online")
    if suite == "posterior" and problem.exact is None:
        raise ConfigError(f"--suite posterior: {run.problem} has no exact answers; use --suite online")


def offline(
    run: Run,
    what: Path,
    results: Path,
    deploy: Deployment | None = None,
    unstored: list[StoreError] | None = None,
    with_references: bool = True,
) -> pd.DataFrame:
    """Offline returns of the folder's models and of references, given random and expert data; see ``online``."""
    evaluated = evaluate.offline(run, models(what, deploy), deploy, with_references)
    return _recorded(run, what, results, "offline", {"evaluated": evaluated}, deploy, unstored)


def experts(run: Run, folder: Path) -> pd.DataFrame:
    """The returns of all recorded episodes of a run's experts, which are written as result rows."""
    data = Dataset(folder / "dataset", readonly=True)
    name = named(folder.resolve().name)
    blocks = [training_rows.of_expert(run, name, data.trials(key)) for key in data.variations("pretrain", 0)]
    data.close()
    return rows.record(folder / "results", "experts", {}, blocks)


def posterior(
    run: Run, what: Path, results: Path, report: ReportEvent, unstored: list[StoreError] | None = None
) -> tuple[pd.DataFrame, dict[str, Any]]:
    """Comparison of the newest model with the exact posterior, on training and on held-out tasks.

    Returns the online returns, which are written as result rows to the folder ``results``, and the numbers.
    """
    agent, model = _agent(open_checkpoint(what), "paper")
    suite, split = registry.of(run).posterior, registry.of(run).split
    assert suite is not None, "``check_suite`` refuses problems without one"

    def decide(
        transitions: Sequence[np.ndarray], queries: Float32[np.ndarray, "B N S"], prefix: Int64[np.ndarray, "B N"]
    ) -> Float64[np.ndarray, "B N A"]:
        probs = model.method.distributions(model.model, transitions, queries, prefix)
        if probs is None:
            raise ConfigError(f"--suite posterior: the model of {run.method} gives no distributions; use --suite online")
        return probs

    act = evaluate.in_context(model, run.context, "paper")
    numbers: dict[str, Any] = {}
    total = len(suite.kinds) * len(suite.levels(run))
    for name, heldout in (("kl_nats", False), ("kl_heldout", True)):
        event = {"event": "progress", "stage": "evaluate", "phase": f"contexts, {_goals(heldout)}", "steps": total}
        found = []
        for pair in suite.divergences(run, decide, act, heldout):
            found.append(pair)
            report(event | {"step": len(found)})
        for prior, ones in zip(suite.priors, zip(*found, strict=True), strict=True):
            numbers |= {f"{name}{prior}{part}": value for part, value in suite.summary(ones).items()}
            numbers[f"{name}{prior}_curves"] = suite.curves(ones)
    evaluated = {}
    for name, tasks in (("test", split.test), ("train", split.train[: len(split.test)])):
        progress = _count(report, f"online, {_goals(name == 'test')}", run, 2)
        evaluated[name] = posterior_suite.online(run, (agent, act), tasks, progress)
    frame = _recorded(run, what, results, "posterior", evaluated, "paper", unstored)
    for name, which in (("paper_gap", "test"), ("paper_gap_train", "train")):
        numbers[name] = posterior_suite.gaps(frame[frame["tasks"] == which])
    return frame, numbers


def _goals(heldout: bool) -> str:
    return f"{'held-out' if heldout else 'training'} goals"


def _count(report: ReportEvent, phase: str, run: Run, agents: int) -> Callable[[str, float, int], None]:
    """A progress callback that displays every episode of every agent at every p as one step."""
    total, done = agents * len(run.evaluate.p) * run.evaluate.episodes, 0

    def progress(agent: str, p: float, episodes: int) -> None:
        nonlocal done
        done += 1
        report({"event": "progress", "stage": "evaluate", "phase": phase, "step": done, "steps": total})

    return progress
