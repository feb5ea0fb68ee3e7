"""``icrl-dist train``: the learner and the workers of one run, then the evaluation."""

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
from icrl_dist.config import plugins
from icrl_dist.config.run import ConfigError, Run, override, run_type, validate
from icrl_dist.storage.fork import parse_source

LOCAL_ACTORS = 2
"""Default number of workers without a cluster."""


@dataclass(frozen=True)
class TrainArguments:
    """Train a method on a run file, then evaluate it on held-out tasks.

    RUN is the name of a packaged run (demo, smoke, darkroom) or the path of a TOML file.

    Every setting of the run can be overridden: ``icrl-dist train demo --method icag --adversary.count 4``.

    With --from, a run starts from T^ROUND of another run, with its data and its other settings:
    ``icrl-dist train --from runs/demo@0 --set adversary.count=16``.
    """

    run: Annotated[tyro.conf.Positional[str], tyro.conf.arg(metavar="[RUN]")] = ""
    """Name of a packaged run, or path of a run file.  If it is left out, --from supplies the
    settings of the other run."""
    source: Annotated[str | None, tyro.conf.arg(name="from")] = None
    """RUN_DIR@ROUND: start from T^ROUND of another run and the data that it was fitted to.  Both are
    shared, not copied."""
    set: tyro.conf.UseAppendAction[tuple[str, ...]] = ()
    """SECTION.NAME=VALUE, such as adversary.count=16.  Can be repeated."""
    engine: Literal["ray", "inline"] = "ray"
    """``ray``: a learner process and Ray workers.  ``inline``: everything in this process, with the same results."""
    address: str | None = None
    """Address of a Ray cluster that runs the workers.  Without it, Ray starts on this machine."""
    actors: int | None = None
    """Number of workers.  Default: 2 on this machine; on a cluster one for each core, including the cores of
    nodes that join later."""
    min_actors: int | None = None
    """On a cluster: start with this many workers after one minute, even if other nodes have not joined."""
    oversubscribe: bool = False
    """Allow more workers than cores.  This is slower; the results are the same."""
    out: Path | None = None
    """Run folder; a leading ``~`` is expanded.  Default: runs/RUN."""
    resume: bool = False
    """Continue the run in the folder from its last checkpoint."""
    overwrite: bool = False
    """Replace the run in the folder.  The old run is removed when the new run has its first checkpoint, and
    restored if the new run ends before that."""
    json: bool = False
    """Print the result as one JSON object on the last line."""
    given: tyro.conf.Suppress[tuple[str, ...]] = ()
    """The words of the command line, for the command that resumes the run."""
    config: Annotated[Run, tyro.conf.arg(name="")] = field(default_factory=lambda: run_type(None)())


def train(arguments: TrainArguments, console: Console) -> int:
    """Train and evaluate.  Returns the exit code, FAILED if a variation is quarantined.

    Heavy modules are imported inside: neither the learner nor the workers wait for torch here.
    """
    from actors.fleet import check_cores
    from icrl_dist.console.display import Display
    from icrl_dist.launch import run_folder
    from icrl_dist.launch import train as launch
    from icrl_dist.storage.files import atomic_write, hold

    if not arguments.run and not arguments.source:
        raise ConfigError("train: name a RUN, such as demo, or another run to start from with --from RUN_DIR@ROUND")
    source = parse_source(arguments.source) if arguments.source else None
    name = Path(arguments.run).stem or f"{source[0].name}-from-{source[1]}" if source else Path(arguments.run).stem
    run = override(arguments.config, arguments.set, "--set")
    validate(run, arguments.run or str(arguments.source))
    trains = plugins.find("methods", run.method).trains
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
    transaction = launch.prepare(run, folder, arguments.resume, arguments.overwrite, source)
    started = time.monotonic()
    with contextlib.ExitStack() as locks:
        try:
            with Display(console) as display:
                with transaction:
                    report = transaction.commit_at_checkpoint(display.report)
                    if arguments.engine == "inline":
                        result = launch.train_inline(run, folder, report)
                    else:
                        options = (arguments.oversubscribe, arguments.min_actors)
                        result = launch.train_ray(run, folder, actors, arguments.address, report, *options)
                locks.enter_context(hold(folder))  # no other command can replace the run during its evaluation
                from icrl_dist.results import heldout  # imports torch, so it comes after the training

                if trains:
                    with launch.interruptible():
                        heldout.save_calibrated(folder, display)
                        frame = heldout.online(run, folder, folder / "results", display)
        except launch.TrainInterrupted:
            text = f"`{_resume_command(arguments.given)}` continues from the checkpoint"
            if transaction.rolled_back or not folder.exists():
                text = f"{folder} is as it was before" if transaction.rolled_back else "nothing had been done yet"
            console.print(f"interrupted; {text}", highlight=False, markup=False, soft_wrap=True)
            return INTERRUPTED
        result |= {"folder": str(folder), "seconds": round(time.monotonic() - started, 1)}
        if not trains:
            evaluation = heldout.show_experts(run, folder, console)
        else:
            evaluation = heldout.show_online(run, folder / "report" / heldout.report_name(run, folder), frame, console)
        result = run_folder.final_result(folder, result, evaluation)
        atomic_write(folder / "result.json", lambda file: file.write(json.dumps(result, indent=1).encode() + b"\n"))
    console.print(
        f"dataset {result['dataset_digest'][:16]}  weights {result['weights_digest'][:16]}  {result['trajectories']} "
        f"trajectories, {result['seconds']:.0f} s, run folder {folder}",
        highlight=False,
        markup=False,
    )
    if result.get("staleness"):
        console.print(f"asynchronous: trajectories by policy lag in versions: {result['lag']}; digests differ between runs")
    for quarantined in result["quarantined"]:
        console.print(f"quarantined: {quarantined['variation']}: {quarantined['cause']}", highlight=False, markup=False)
    if arguments.json:
        print(json.dumps(result))
    return FAILED if result["quarantined"] else OK


def _resume_command(given: Sequence[str]) -> str:
    """The shell command that resumes a run started as ``icrl-dist train`` with the words ``given``."""
    words = [word for word in given if word not in ("--overwrite", "--resume")]
    position = 1 if words and not words[0].startswith("-") else len(words)  # after RUN, or at the end
    return shlex.join(["icrl-dist", "train", *words[:position], "--resume", *words[position:]])
