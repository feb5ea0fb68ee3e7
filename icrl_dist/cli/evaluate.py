"""``icrl-dist evaluate``: returns of a trained agent on tasks that it did not train on."""

from __future__ import annotations

import dataclasses
import json
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro
from rich.console import Console

from icrl_dist.cli.exit_codes import OK
from icrl_dist.config.run import ConfigError, Deployment, validate


@dataclass(frozen=True)
class EvaluateArguments:
    """Evaluate a trained agent on tasks that it did not train on, beside T^0, exact agents and the oracle."""

    what: Annotated[tyro.conf.Positional[Path | None], tyro.conf.arg(metavar="[RUN_DIR]")] = None
    """A run folder, or a checkpoint file."""
    pretrained: str | None = None
    """Instead, the name of an agent that is part of the package: ``darkroom``.  Its report is
    written to runs/NAME-pretrained."""
    suite: Literal["online", "offline", "posterior"] = "online"
    """``online``: consecutive episodes from an empty context.  ``offline``: one episode, given the
    context of a random or an expert episode (Algorithm 1).  ``posterior``: KL divergence of its action
    distribution from the exact posterior's, in nats, and the difference of its return to the exact agent's."""
    deploy: Deployment | None = None
    """``paper``: Algorithm 1, the context is fixed within an episode.  ``committed``: every transition
    joins the context at once, and the agent's own recent actions are its action window.  Default:
    ``committed`` for an agent trained on action windows (model.window), else ``paper``.  The
    posterior suite always uses ``paper``."""
    episodes: int | None = None
    """Online episodes.  Default: the run's number (posterior: 40)."""
    seeds: int | None = None
    """Evaluations per task.  Default: the run's number (posterior: 2)."""
    p: tuple[float, ...] = ()
    """Override probabilities to test.  Default: the run's (posterior: 0 0.2 0.4 0.6)."""
    prior: Literal["uniform", "unseen"] | None = None
    """Distribution of the test adversaries.  Default: the run's (posterior: uniform)."""
    json: bool = False
    """Print one JSON object on the last line."""


def evaluate(arguments: EvaluateArguments, console: Console) -> int:
    """Evaluate, print the table and keep the report.  Returns the exit code."""
    from icrl_dist.agent.loading import checkpoint_file
    from icrl_dist.config.run import parse_written
    from icrl_dist.console.display import Display
    from icrl_dist.methods import registry as methods
    from icrl_dist.results import heldout
    from icrl_dist.results.rows import is_unfinished
    from icrl_dist.storage.checkpoint import load_checkpoint

    what, folder = _source_and_output(arguments)
    checkpoint = load_checkpoint(checkpoint_file(what))
    run = parse_written(str(checkpoint.manifest.get("run", "")), str(what))
    options = {name: getattr(arguments, name) for name in ("episodes", "seeds", "p", "prior")}
    chosen = {name: value for name, value in options.items() if value not in (None, ())}
    if arguments.suite == "posterior":
        chosen = {"p": (0.0, 0.2, 0.4, 0.6), "prior": "uniform", "episodes": 40, "seeds": 2} | chosen
    run = dataclasses.replace(run, evaluate=dataclasses.replace(run.evaluate, **chosen))
    validate(run, "evaluate")
    heldout.check_suite(run, arguments.suite)
    deploy = "paper" if arguments.suite == "posterior" else arguments.deploy or methods.of(run).deployment(run)
    answer: dict[str, Any] = {"suite": arguments.suite, "deploy": deploy, "what": str(what)}
    report = folder / "report" / heldout.report_name(run, what, arguments.suite, deploy)
    results = _results_folder(folder)
    if arguments.what is not None and is_unfinished(what):
        console.print(
            f"{what}: this run is not finished; the newest version so far is evaluated", highlight=False, markup=False
        )
    if arguments.suite == "online":
        with Display(console) as display:
            frame = heldout.online(run, what, results, display, arguments.deploy)
        answer |= heldout.show_online(run, report, frame, console)
    elif arguments.suite == "posterior":
        with Display(console) as display:
            divergences = heldout.posterior(run, what, results, display)
        answer |= heldout.show_posterior(run, report, divergences, console)
    else:
        answer |= heldout.show_offline(run, heldout.offline(run, what, results, arguments.deploy), console)
    if arguments.json:
        print(json.dumps(answer))
    return OK


def _source_and_output(arguments: EvaluateArguments) -> tuple[Path, Path]:
    """The run folder or checkpoint to evaluate, and the folder that its report and result rows are written below."""
    from icrl_dist.agent.loading import shipped

    what, name = arguments.what, arguments.pretrained
    if what is not None and name is None:
        return what, what if what.is_dir() else what.parent
    if what is None and name is not None:
        return shipped(name), Path("runs") / f"{name}-pretrained"
    raise ConfigError("evaluate: name a run folder or a checkpoint file, or with --pretrained an agent of the package")


def _results_folder(folder: Path) -> Path:
    """Where the result rows are written: rows of a checkpoint in a run folder belong to that run."""
    run = folder.parent if folder.name == "checkpoints" and (folder.parent / "run.toml").exists() else folder
    return run / "results"
