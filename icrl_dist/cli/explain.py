"""``icrl-dist explain``: the origin of a training example."""

from __future__ import annotations

import json
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro
from rich.console import Console

from icrl_dist.cli.exit_codes import FAILED, OK
from icrl_dist.config.run import ConfigError
from icrl_dist.types import Identity


@dataclass(frozen=True)
class ExplainArguments:
    """Show the origin of a training example: task, adversary, weights, seed, worker, labels, bytes.

    Without IDENTITY: print all trajectories, one JSON line each, and on standard error every file that is damaged or missing.
    """

    what: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="RUN_DIR")]
    """Run folder."""
    identity: Annotated[tyro.conf.Positional[str | None], tyro.conf.arg(metavar="[IDENTITY]")] = None
    """STAGE/ROUND/TASK/VARIATION/TRIAL, such as adapt/0/3/1/7."""
    rerun: bool = False
    """Repeat the rollout on this machine and compare every byte."""
    json: bool = False
    """Print one JSON object on the last line."""


def explain(arguments: ExplainArguments, console: Console) -> int:
    """Print the origin of one trajectory, or of all and each damaged file.  Returns FAILED if a stored byte has changed."""
    from icrl_dist.diagnostics import explain as origin

    if arguments.identity is None:
        for line in origin.ledger(arguments.what):
            print(json.dumps(line))
        damage = origin.damage(arguments.what)
        for text in damage:
            print(f"icrl-dist: {text}", file=sys.stderr)
        return FAILED if damage else OK
    try:
        identity = Identity.parse(arguments.identity)
    except ValueError as error:
        raise ConfigError(f"explain: {error}") from None
    answer = origin.explain(arguments.what, identity, arguments.rerun)
    console.print(origin.describe(answer), highlight=False, markup=False)
    if arguments.json:
        print(json.dumps(answer))
    unchanged = answer["intact"] and answer.get("weights_intact", True) and answer.get("rerun_equal", True)
    return OK if unchanged else FAILED
