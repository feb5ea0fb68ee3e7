"""``icrl-dist explain``."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path

import tyro
from rich.console import Console

from icrl_dist.cli.exit_codes import FAILED, OK
from icrl_dist.config.run import ConfigError
from icrl_dist.types import Identity


@dataclass(frozen=True)
class ExplainArguments:
    """Where a training example came from: task, adversary, weights, seed, worker, labels, bytes.

    Without IDENTITY: the whole ledger, a JSON line a trajectory.
    """

    what: tyro.conf.Positional[Path]
    """Run folder."""
    identity: tyro.conf.Positional[str | None] = None
    """STAGE/ROUND/TASK/VARIATION/TRIAL, such as adapt/0/3/1/7."""
    rerun: bool = False
    """Make it once more on this machine and compare every byte."""
    json: bool = False
    """Print one JSON object on the last line."""


def explain(arguments: ExplainArguments, console: Console) -> int:
    """``icrl-dist explain``: one trajectory's origin, or the whole ledger."""
    from icrl_dist.diagnostics import explain as explaining

    if arguments.identity is None:
        for line in explaining.ledger(arguments.what):
            print(json.dumps(line))
        return OK
    try:
        identity = Identity.parse(arguments.identity)
    except ValueError as error:
        raise ConfigError(f"explain: {error}") from None
    answer = explaining.explain(arguments.what, identity, arguments.rerun)
    console.print(explaining.describe(answer), highlight=False, markup=False)
    if arguments.json:
        print(json.dumps(answer))
    sound = answer["intact"] and answer.get("weights_intact", True) and answer.get("rerun_equal", True)
    return OK if sound else FAILED
