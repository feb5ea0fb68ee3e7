"""``icrl-dist plan``: an estimate of a run's time, network and disk."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro
from rich.console import Console

from icrl_dist.cli.exit_codes import OK
from icrl_dist.config.run import load, override


@dataclass(frozen=True)
class PlanArguments:
    """Estimate what a run takes on N nodes: hours, network, disk, and its first bottleneck.

    Measures a small part of each stage of the run on this machine.  This takes some tens of seconds,
    during which nothing else should run.  The nodes are assumed to be as fast as this machine.
    """

    run: Annotated[tyro.conf.Positional[str], tyro.conf.arg(metavar="RUN")]
    """Name of a packaged run, or path of a run file."""
    nodes: int = 1
    """Nodes that run workers."""
    cores: int | None = None
    """Workers on each node.  Default: the number of cores of this machine."""
    gbit: float = 1.0
    """Bandwidth of the learner's network, Gbit/s."""
    set: tyro.conf.UseAppendAction[tuple[str, ...]] = ()
    """SECTION.NAME=VALUE, such as adversary.count=16.  Can be repeated."""
    rates: Path | None = None
    """File with the output of --json from an earlier measurement, or from another machine; nothing is measured then."""
    json: bool = False
    """Print one JSON object, including the measured rates, on the last line."""


def plan(arguments: PlanArguments, console: Console) -> int:
    """Measure the rates, or read them from a file, and print the estimate.  Returns the exit code."""
    from icrl_dist.bench import rates
    from icrl_dist.diagnostics import estimate

    run = override(load(arguments.run), arguments.set, "--set")
    if arguments.rates is not None:
        measured = estimate.Rates.read(arguments.rates, arguments.run)
    else:
        with console.status("plan") as status:
            measured = rates.measure(run, arguments.run, lambda part: status.update(f"timing {part}"))
    answer = estimate.estimate(measured, arguments.nodes, arguments.cores or measured.cores, arguments.gbit)
    console.print(estimate.describe(answer), highlight=False, markup=False)
    if arguments.json:
        print(json.dumps({**answer, "rates": measured.as_dict()}))
    return OK
