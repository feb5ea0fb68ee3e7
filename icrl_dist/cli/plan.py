"""``icrl-dist plan``."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path

import tyro
from rich.console import Console

from icrl_dist.cli.exit_codes import OK
from icrl_dist.config.run import load, override


@dataclass(frozen=True)
class PlanArguments:
    """What a run would take on N machines: hours, network, disk, and what holds it up first.

    Times a little of each part of the run on this machine, some tens of seconds while nothing else
    should run; machines are taken to be like this one.
    """

    run: tyro.conf.Positional[str]
    """Name of a packaged run, or path of a run file."""
    nodes: int = 1
    """Machines that run workers."""
    cores: int | None = None
    """Workers on each; as many as this machine has cores if not given."""
    gbit: float = 1.0
    """What the learner's network carries, Gbit/s."""
    set: tyro.conf.UseAppendAction[tuple[str, ...]] = ()
    """SECTION.NAME=VALUE, as in adversary.count=16; may be given many times."""
    rates: Path | None = None
    """Rates that were measured before, or on another machine: what --json printed there."""
    json: bool = False
    """Print one JSON object on the last line, the rates included."""


def plan(arguments: PlanArguments, console: Console) -> int:
    """``icrl-dist plan``: an estimate from measured rates."""
    from icrl_dist.bench import rates
    from icrl_dist.diagnostics import estimate

    run = override(load(arguments.run), arguments.set, "--set")
    if arguments.rates is not None:
        found = estimate.Rates.read(arguments.rates, arguments.run)
    else:
        with console.status("plan") as status:
            found = rates.measure(run, arguments.run, lambda said: status.update(f"timing {said}"))
    answer = estimate.estimate(found, arguments.nodes, arguments.cores or found.cores, arguments.gbit)
    console.print(estimate.describe(answer), highlight=False, markup=False)
    if arguments.json:
        print(json.dumps({**answer, "rates": found.as_dict()}))
    return OK
