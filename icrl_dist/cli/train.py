"""``icrl-dist train``."""

from __future__ import annotations

import contextlib
import json
import shlex
import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Literal

import tyro
from rich.console import Console

from icrl_dist.cli.exit_codes import FAILED, INTERRUPTED, OK
from icrl_dist.config.run import ConfigError, Run, override, validate
from icrl_dist.storage.fork import parse_source

LOCAL_ACTORS = 2
"""Workers on one machine, if nobody says how many."""


@dataclass(frozen=True)
class TrainArguments:
    """Run a method from its first trajectory to its evaluation on held-out tasks.

    RUN is a packaged run (demo, smoke, darkroom) or the path of a TOML file.  Every number of
    the run can be overridden: ``icrl-dist train demo --method icag --adversary.count 4``.
    ``icrl-dist train --from runs/demo@0 --set adversary.count=16`` goes on from T^0 of another
    run, with its data and other numbers.
    """

    run: tyro.conf.Positional[str] = ""
    """Name of a packaged run, or path of a run file; with --from the other run's numbers are
    taken if it is left out."""
    source: Annotated[str | None, tyro.conf.arg(name="from")] = None
    """RUN_DIR@ROUND: begin with T^ROUND of another run and the data it was fitted to; both are
    shared, not copied."""
    set: tyro.conf.UseAppendAction[tuple[str, ...]] = ()
    """SECTION.NAME=VALUE, as in adversary.count=16; may be given many times."""
    engine: Literal["ray", "inline"] = "ray"
    """``ray``: a learner process and Ray workers; ``inline``: all in this process, same results."""
    address: str | None = None
    """Address of a Ray cluster to take workers from; without it Ray starts here."""
    actors: int | None = None
    """Workers: 2 on this machine; on a cluster as many as its machines have cores, and more when more join."""
    min_actors: int | None = None
    """On a cluster: begin with so many after a minute, though other machines have not joined."""
    oversubscribe: bool = False
    """Allow more workers than cores: slower, and the same results."""
    out: Path | None = None
    """Run folder, ``~`` included where no shell has resolved it; runs/RUN if not given."""
    resume: bool = False
    """Go on with the run in the folder from its last checkpoint."""
    overwrite: bool = False
    """Replace the run in the folder: it is removed once the new one has its first checkpoint, and comes
    back if the new one ends before that."""
    json: bool = False
    """Print the result as one JSON object on the last line."""
    given: tyro.conf.Suppress[tuple[str, ...]] = ()
    """The words of the command."""
    config: Annotated[Run, tyro.conf.arg(name="")] = field(default_factory=Run)


def train(arguments: TrainArguments, console: Console) -> int:
    """``icrl-dist train``: both programs to their end, then the evaluation."""
    from actors.fleet import check_cores
    from icrl_dist.console.display import Display
    from icrl_dist.launch import run_folder
    from icrl_dist.launch import train as launch
    from icrl_dist.storage.files import atomic_write, hold

    if not arguments.run and not arguments.source:
        raise ConfigError("train: name a RUN, such as demo, or another run to go on from with --from RUN_DIR@ROUND")
    source = parse_source(arguments.source) if arguments.source else None
    name = Path(arguments.run).stem or f"{source[0].name}-from-{source[1]}" if source else Path(arguments.run).stem
    run = override(arguments.config, arguments.set, "--set")
    validate(run, arguments.run or str(arguments.source))
    try:
        folder = (arguments.out or Path("runs") / name).expanduser().absolute()
    except RuntimeError as error:
        raise ConfigError(f"--out {arguments.out}: {error}") from None
    for option, value in (("--actors", arguments.actors), ("--min-actors", arguments.min_actors)):
        if value is not None and value < 1:
            raise ConfigError(f"{option} {value}: at least 1 worker is needed")
    actors = LOCAL_ACTORS if arguments.actors is None and arguments.address is None else arguments.actors
    if arguments.engine == "ray" and arguments.address is None and not arguments.oversubscribe:
        check_cores(actors or LOCAL_ACTORS)
    if arguments.engine == "ray":
        launch.check_security(run, arguments.address)
    begun = launch.prepare(run, folder, arguments.resume, arguments.overwrite, source)
    began = time.monotonic()
    with contextlib.ExitStack() as held:
        try:
            with Display(console) as display:
                with begun:
                    report = begun.heed(display.report)
                    if arguments.engine == "inline":
                        result = launch.train_inline(run, folder, report)
                    else:
                        options = (arguments.oversubscribe, arguments.min_actors)
                        result = launch.train_ray(run, folder, actors, arguments.address, report, *options)
                held.enter_context(hold(folder))  # as the learner did: nobody replaces the run while it is evaluated
                from icrl_dist.results import (
                    heldout,  # torch with it, which neither the learner nor the workers should wait for
                )

                if run.method != "experts":
                    with launch.interruptible():
                        heldout.keep_calibrated(folder, display)
                        results = heldout.online(run, folder, display)
        except launch.TrainInterrupted:
            told = f"`{_resuming(arguments.given)}` goes on from the checkpoint"
            if begun.restored or not folder.exists():
                told = f"{folder} is as it was before" if begun.restored else "nothing had been done yet"
            console.print(f"interrupted; {told}", highlight=False, markup=False, soft_wrap=True)
            return INTERRUPTED
        result |= {"folder": str(folder), "seconds": round(time.monotonic() - began, 1)}
        if run.method == "experts":
            evaluated = heldout.show_experts(folder, console)
        else:
            evaluated = heldout.show_online(run, folder / "report" / heldout.report_name(run, folder), *results, console)
        result = run_folder.concluded(folder, result, evaluated)
        atomic_write(folder / "result.json", lambda file: file.write(json.dumps(result, indent=1).encode() + b"\n"))
    console.print(
        f"dataset {result['dataset_digest'][:16]}  weights {result['weights_digest'][:16]}  {result['trajectories']} "
        f"trajectories, {result['seconds']:.0f} s, run folder {folder}",
        highlight=False,
        markup=False,
    )
    if result.get("staleness"):
        console.print(f"asynchronous: trajectories by versions behind: {result['lag']}; digests differ from run to run")
    for given_up in result["quarantined"]:
        console.print(f"quarantined: {given_up['variation']}: {given_up['cause']}", highlight=False, markup=False)
    if arguments.json:
        print(json.dumps(result))
    return FAILED if result["quarantined"] else OK


def _resuming(given: Sequence[str]) -> str:
    """The command that goes on with what ``icrl-dist train`` was given, for a shell."""
    words = [word for word in given if word not in ("--overwrite", "--resume")]
    where = 1 if words and not words[0].startswith("-") else len(words)  # behind RUN, or at the end
    return shlex.join(["icrl-dist", "train", *words[:where], "--resume", *words[where:]])
