"""``icrl-dist train``: the learner and the workers of one run, then the evaluation."""

from __future__ import annotations

import contextlib
import json
import shlex
import sys
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import tyro
from rich.console import Console

from icrl_dist.cli.exit_codes import FAILED, INTERRUPTED, OK
from icrl_dist.config.run import Run, load_folder, override, run_type

if TYPE_CHECKING:
    from icrl_dist.results.reports import Evaluation


@dataclass(frozen=True)
class TrainArguments:
    """Train a method on a run file, then evaluate it on held-out tasks.

    RUN is the name of a packaged run (demo, smoke, darkroom) or the path of a TOML file; with --resume also a run folder.

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
    """Number of workers.  Default: 2 on this machine, or 1 on a single core; on a cluster one for each core,
    including the cores of nodes that join later."""
    min_actors: int | None = None
    """On a cluster: start with this many workers after one minute, even if other nodes have not joined."""
    oversubscribe: bool = False
    """Allow more workers than cores.  This is slower; the results are the same."""
    out: Path | None = None
    """Run folder; a leading ``~`` is expanded.  Default: runs/RUN."""
    resume: bool = False
    """Continue the run in the folder from its last checkpoint: ``icrl-dist train --resume runs/demo``."""
    resume_or_begin: bool = False
    """Continue the run in the folder, or begin it if there is none.  A finished run ends the command at once.
    For a command that a batch system repeats."""
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

    Whatever ends the run early, the last line printed is the command that continues it.
    """
    from icrl_dist.console.display import Display
    from icrl_dist.launch import resuming, whole_run
    from icrl_dist.launch.learner_process import TrainFailed
    from icrl_dist.launch.train import TrainInterrupted
    from icrl_dist.storage.files import StoreError, explained

    options = (
        *("engine", "address", "actors", "min_actors", "oversubscribe", "source"),
        *("resume", "resume_or_begin", "overwrite"),
    )
    given = {name: getattr(arguments, name) for name in options}
    run = override(arguments.config, arguments.set, "--set") if arguments.run or arguments.source else None
    going_on = arguments.resume or arguments.resume_or_begin
    out = resuming.place(arguments.run, arguments.out, arguments.source, going_on)
    only_begin_or_resume = arguments.resume_or_begin and not arguments.resume and not arguments.overwrite
    if run is not None and only_begin_or_resume and (earlier := resuming.finished(run, out)) is not None:
        console.print("the run is finished: there is nothing to do", highlight=False)
        return _show_result(earlier, out.absolute(), arguments.json, console)
    command = _resume_command(arguments.given)
    try:
        with Display(console) as display:
            made = whole_run.train(run, out, **given, progress=display.report)
    except TrainInterrupted as error:
        text = f"`{command}` continues from {error.kept}" if error.resumable else str(error)
        console.print(f"interrupted; {text}", highlight=False, markup=False, soft_wrap=True)
        return INTERRUPTED
    except BrokenPipeError:
        with contextlib.suppress(BrokenPipeError):
            print(f"icrl-dist: the output is closed; `{command}` continues from the checkpoint", file=sys.stderr)
        raise
    except (TrainFailed, StoreError, OSError) as error:
        cause = explained(error)
        if run is None or isinstance(cause, OSError) or not resuming.holds(run, out):
            raise
        raise TrainFailed(f"{cause}; `{command}` continues the run") from error
    _print_evaluation(made.evaluation, load_folder(made.folder), console)
    return _show_result(made.result, made.folder, arguments.json, console)


def _show_result(result: dict[str, Any], folder: Path, as_json: bool, console: Console) -> int:
    """Print what a finished run produced; returns the exit code."""
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
    if as_json:
        print(json.dumps(result))
    return FAILED if result["quarantined"] else OK


def _print_evaluation(evaluation: Evaluation, run: Run, console: Console) -> None:
    """The returns of the evaluated tasks in four rows with a conclusion; everything about experts."""
    from icrl_dist.problems import registry
    from icrl_dist.results import conclusion

    if set(evaluation.rows["suite"]) != {"online"}:
        console.print(evaluation)
        return
    console.print(conclusion.table(evaluation.rows, registry.of(run).title))
    for line in (conclusion.sentence(evaluation.rows), *evaluation.notes):
        console.print(line, highlight=False, markup=False)


def _resume_command(given: Sequence[str]) -> str:
    """The shell command that resumes a run started as ``icrl-dist train`` with the words ``given``."""
    if "--resume-or-begin" in (word.replace("_", "-") for word in given):
        return shlex.join(["icrl-dist", "train", *given])
    words = [word for word in given if word not in ("--overwrite", "--resume")]
    position = 1 if words and not words[0].startswith("-") else len(words)  # after RUN, or at the end
    return shlex.join(["icrl-dist", "train", *words[:position], "--resume", *words[position:]])
