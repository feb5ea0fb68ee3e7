"""``icrl-dist evaluate``."""

from __future__ import annotations

import dataclasses
import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import tyro
from rich.console import Console

from icrl_dist.cli.exit_codes import OK
from icrl_dist.config.run import ConfigError, Deployment, validate


@dataclass(frozen=True)
class EvaluateArguments:
    """Deploy a trained agent on tasks it never trained on, beside T^0, exact agents and the oracle."""

    what: tyro.conf.Positional[Path | None] = None
    """A run folder, or a checkpoint file."""
    pretrained: str | None = None
    """Instead, the name of an agent that comes with the package: ``darkroom``.  Its report is
    written under runs/NAME-pretrained."""
    suite: Literal["online", "offline", "posterior"] = "online"
    """``online``: episode after episode from an empty context; ``offline``: one episode given a
    random or an expert one (Algorithm 1); ``posterior``: how far its decisions are from the exact
    posterior's, in nats, and its return from the exact agent's."""
    deploy: Deployment | None = None
    """``paper``: Algorithm 1, the context frozen within an episode; ``committed``: every transition
    joins the context at once, and a guess once acted on is kept.  Committed if not given, for an
    agent that was trained on windows (model.window); the posterior suite is about ``paper``."""
    episodes: int | None = None
    """Online episodes; the run's own number if not given (posterior: 40)."""
    seeds: int | None = None
    """Evaluations of every task; the run's own number if not given (posterior: 2)."""
    p: tuple[float, ...] = ()
    """Override probabilities to test; the run's own if none are given (posterior: 0 0.2 0.4 0.6)."""
    prior: Literal["uniform", "unseen"] | None = None
    """Law of the test adversary; the run's own if not given (posterior: uniform)."""
    json: bool = False
    """Print one JSON object on the last line."""


def evaluate(arguments: EvaluateArguments, console: Console) -> int:
    """``icrl-dist evaluate``: per-episode returns beside the oracle's."""
    from icrl_dist.agent.in_context_agent import checkpoint_file
    from icrl_dist.config.run import default_deployment, parse
    from icrl_dist.console.display import Display
    from icrl_dist.results import heldout
    from icrl_dist.storage.files import load_checkpoint

    what, folder = _evaluated(arguments)
    checkpoint = load_checkpoint(checkpoint_file(what))
    run = parse(str(checkpoint.manifest.get("run", "")), str(what))
    given = {name: getattr(arguments, name) for name in ("episodes", "seeds", "p", "prior")}
    chosen = {name: value for name, value in given.items() if value not in (None, ())}
    if arguments.suite == "posterior":
        chosen = {"p": (0.0, 0.2, 0.4, 0.6), "prior": "uniform", "episodes": 40, "seeds": 2} | chosen
    run = dataclasses.replace(run, evaluate=dataclasses.replace(run.evaluate, **chosen))
    validate(run, "evaluate")
    if run.problem != "darkroom" and arguments.suite != "online":
        raise ConfigError(f"--suite {arguments.suite}: only Dark Room has that so far; {run.problem} has --suite online")
    deploy = "paper" if arguments.suite == "posterior" else arguments.deploy or default_deployment(run.model)
    answer: dict[str, Any] = {"suite": arguments.suite, "deploy": deploy, "what": str(what)}
    report = folder / heldout.report_name(run, what, arguments.suite, deploy)
    if arguments.suite == "online":
        with Display(console) as display:
            results = heldout.online(run, what, display, arguments.deploy)
        answer |= heldout.show_online(run, report, *results, console)
    elif arguments.suite == "posterior":
        with Display(console) as display:
            found = heldout.posterior(run, what, display)
        answer |= heldout.show_posterior(run, report, found, console)
    else:
        answer |= heldout.show_offline(heldout.offline(run, what, arguments.deploy), console)
    if arguments.json:
        print(json.dumps(answer))
    return OK


def _evaluated(arguments: EvaluateArguments) -> tuple[Path, Path]:
    """What is to be evaluated, and the folder of its report."""
    from icrl_dist.agent.in_context_agent import shipped

    what, name = arguments.what, arguments.pretrained
    if what is not None and name is None:
        return what, (what if what.is_dir() else what.parent) / "report"
    if what is None and name is not None:
        return shipped(name), Path("runs") / f"{name}-pretrained" / "report"
    raise ConfigError("evaluate: name a run folder or a checkpoint file, or with --pretrained an agent that is shipped")
