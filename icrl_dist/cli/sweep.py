"""``icrl-dist sweep``: many runs from one file."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import tyro
from rich.console import Console

from icrl_dist.cli.exit_codes import FAILED, INTERRUPTED, OK


@dataclass(frozen=True)
class SweepArguments:
    """Train and evaluate many runs from one file: every method in every setting with every seed.

    FILE is a TOML file: ``run``, ``seeds``, and tables ``[settings.NAME]``, ``[methods.NAME]`` and ``[evaluations.NAME]``.
    docs/sweeps.md explains every key.

    The same command continues a sweep that was interrupted, and does only what is missing:
    ``icrl-dist sweep FILE --only icag --seeds 10 11`` does a part of it.

    All result rows are in rows.parquet of the sweep's folder, and runs.json has the digests of every run.
    """

    file: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="FILE")]
    """The sweep file."""
    out: Path | None = None
    """Folder of the sweep.  Default: runs/ and the name of the file.  Each run lies in OUT/SETTING/METHOD/SEED."""
    only: tuple[str, ...] = ()
    """Only these methods of the file."""
    settings: tuple[str, ...] = ()
    """Only these settings of the file."""
    seeds: tuple[int, ...] = ()
    """Only these training seeds of the file."""
    jobs: int | None = None
    """Number of runs at a time, each in a process with one thread.  Default: one for each core."""
    address: str | None = None
    """Address of a Ray cluster whose nodes share OUT, such as ``auto``; runs are then tasks of one core each."""
    keep: Literal["all", "weights", "rows"] = "weights"
    """What is kept of a run that is done: ``all``; ``weights``, all but its dataset; or only its result ``rows``."""
    dry_run: bool = False
    """Only list the runs, with their budgets and what is done."""
    json: bool = False
    """Print a summary as one JSON object on the last line."""


def sweep(arguments: SweepArguments, console: Console) -> int:
    """Do the sweep, or list its runs.  Returns the exit code, FAILED if a run failed."""
    from icrl_dist.console.display import Display
    from icrl_dist.launch.train import TrainInterrupted
    from icrl_dist.sweeps import sweep as sweeps

    chosen = {name: getattr(arguments, name) for name in ("only", "settings", "seeds")}
    if arguments.dry_run:
        made = sweeps.make_plan(arguments.file, arguments.out, **chosen)
        for line in sweeps.describe(made):
            console.print(line, highlight=False, markup=False, soft_wrap=True)
        if arguments.json:
            print(json.dumps({"out": str(made.out), "runs": [one.name for one in made.chosen]}))
        return OK
    options = {name: getattr(arguments, name) for name in ("jobs", "address", "keep")}
    try:
        with Display(console) as display:
            found = sweeps.sweep(arguments.file, arguments.out, **chosen, **options, progress=display.report)
    except TrainInterrupted as error:
        console.print(f"interrupted; {error}", highlight=False, markup=False, soft_wrap=True)
        return INTERRUPTED
    for one in found.failed:
        text = f"failed: {one['run']}: {one['cause']}; log: {one['log']}"
        console.print(text, highlight=False, markup=False, soft_wrap=True)
    summary = found.summary
    console.print(
        f"{summary['done']} of {summary['runs']} runs done, {summary['rows']} rows in {found.out / 'rows.parquet'}",
        highlight=False,
        markup=False,
        soft_wrap=True,
    )
    if arguments.json:
        print(json.dumps(summary))
    return FAILED if found.failed else OK
