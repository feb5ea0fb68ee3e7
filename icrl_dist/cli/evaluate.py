"""``icrl-dist evaluate``: returns of a trained agent on tasks that it did not train on."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import tyro
from rich.console import Console

from icrl_dist.cli.exit_codes import OK
from icrl_dist.config.run import ConfigError, Deployment


@dataclass(frozen=True)
class EvaluateArguments:
    """Evaluate a trained agent on tasks that it did not train on, beside T^0, exact agents and the oracle."""

    what: Annotated[tyro.conf.Positional[Path | None], tyro.conf.arg(metavar="[RUN_DIR]")] = None
    """A run folder, or a checkpoint file."""
    pretrained: str | None = None
    """Instead, the name of an agent that is part of the package: ``darkroom``.  Its report is
    written to runs/NAME-pretrained."""
    suite: Literal["online", "offline", "posterior", "attack", "worst"] = "online"
    """``online``: consecutive episodes from an empty context.  ``offline``: one episode, given the
    context of a random or an expert episode (Algorithm 1).  ``posterior``: KL divergence of its action
    distribution from the exact posterior's, in nats, and the difference of its return to the exact agent's.
    ``attack``: the return of one episode, given its context, without adversary, under sampled ones and under the
    worst one of strength p, which is exact for Algorithm 1 (Dark Room).  ``worst``: the return under SAC adversaries that
    are trained against each agent (DeepMind Control); it takes as long as training that many experts."""
    deploy: Deployment | None = None
    """``paper``: Algorithm 1, the context is fixed within an episode.  ``committed``: every transition
    joins the context at once, and the agent's own recent actions are its action window.  ``growing``: every
    transition joins the context at once.  Default: ``committed`` for an agent trained on action windows
    (model.window), ``growing`` for one of the method ``ad``, else ``paper``.  The suites posterior and worst
    always use ``paper``."""
    episodes: int | None = None
    """Online episodes.  Default: the run's number (posterior: 40)."""
    seeds: int | None = None
    """Evaluations per task.  Default: the run's number (posterior: 4).  Each evaluation of a task has a test
    adversary of its own."""
    p: tuple[float, ...] = ()
    """Probabilities p of a disturbed step to test.  Default: the run's (posterior: 0 0.2 0.4 0.6; attack, worst: those above
    0)."""
    prior: Literal["uniform", "unseen"] | None = None
    """Distribution of the test adversaries.  Default: the run's (posterior: uniform)."""
    draws: int = 8
    """Suite ``attack``: adversaries that are sampled from the unseen prior."""
    adversaries: int = 3
    """Suite ``worst``: adversaries for each agent and task."""
    steps: int = 50_000
    """Suite ``worst``: environment steps of the training of each adversary; the other settings are those of ``[sac]``."""
    references: bool = True
    """Also evaluate random policy, exact agents and oracle."""
    json: bool = False
    """Print one JSON object on the last line."""


def evaluate(arguments: EvaluateArguments, console: Console) -> int:
    """Evaluate, print the table and keep the report.  Returns the exit code."""
    from icrl_dist.agent.loading import shipped
    from icrl_dist.console.display import Display
    from icrl_dist.results import suites

    what: str | Path | None = arguments.what if arguments.pretrained is None else arguments.pretrained
    if what is None or None not in (arguments.what, arguments.pretrained):
        raise ConfigError("evaluate: name a run folder or a checkpoint file, or with --pretrained an agent of the package")
    if arguments.pretrained is not None:
        shipped(arguments.pretrained)  # a name of the package only, never that of a folder
    options = {
        name: getattr(arguments, name)
        for name in ("suite", "deploy", "episodes", "seeds", "prior", "draws", "adversaries", "steps", "references")
    }
    with Display(console) as display:
        found = suites.evaluate(what, **options, p=arguments.p or None, progress=display.report)
    console.print(found)
    if arguments.json:
        print(json.dumps(found.summary))
    return OK
