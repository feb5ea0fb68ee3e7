"""The command line ``icrl-dist COMMAND``: parses the arguments and calls the command.

Exit codes: 0 done, 1 the run failed, 2 bad usage or config, 130 interrupted with a
checkpoint written.
"""

from __future__ import annotations

import io
import os
import shutil
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from rich.console import Console

from icrl_dist.cli import (
    bench,
    chaos,
    doctor,
    evaluate,
    explain,
    export,
    help_text,
    monitor,
    plan,
    play,
    report,
    streams,
    sweep,
    train,
)
from icrl_dist.cli.exit_codes import FAILED, INTERRUPTED, OK, USAGE
from icrl_dist.cli.train import TrainArguments
from icrl_dist.config import former_names
from icrl_dist.config.run import ConfigError, Run, load, load_folder, names_of, run_folder_of, run_type, with_problem
from icrl_dist.console.signals import interruptible
from icrl_dist.console.terminal import PlainConsole
from icrl_dist.storage.fork import parse_source
from icrl_dist.stream.excerpts import plain

COMMANDS: dict[str, tuple[type, Callable[[Any, Console], int]]] = {
    "train": (train.TrainArguments, train.train),
    "evaluate": (evaluate.EvaluateArguments, evaluate.evaluate),
    "monitor": (monitor.MonitorArguments, monitor.monitor),
    "tap": (monitor.TapArguments, monitor.tap),
    "bench": (bench.BenchArguments, bench.bench),
    "explain": (explain.ExplainArguments, explain.explain),
    "export": (export.ExportArguments, export.export),
    "chaos": (chaos.ChaosArguments, chaos.chaos),
    "report": (report.ReportArguments, report.report),
    "play": (play.PlayArguments, play.play),
    "doctor": (doctor.DoctorArguments, doctor.doctor),
    "plan": (plan.PlanArguments, plan.plan),
    "sweep": (sweep.SweepArguments, sweep.sweep),
}

_RENAMED = {"bench": {"--bite": "--drop"}}
"""For each command the former names of options, and the present ones."""


def _help() -> str:
    lines = ["icrl-dist: robust in-context reinforcement learning, distributed", "", "usage: icrl-dist COMMAND ...", ""]
    width = min(100, shutil.get_terminal_size().columns)
    texts = {name: (kind.__doc__ or "").splitlines()[0] for name, (kind, _) in COMMANDS.items()}
    lines += [help_text.filled(f"  {name:<10} {text}", width, " " * 13) for name, text in texts.items()]
    last = "``icrl-dist COMMAND --help`` explains a command; start with ``icrl-dist train demo``."
    return "\n".join([*lines, "", help_text.filled(last, width).replace("``", "`")])


def _parse(name: str, words: Sequence[str]) -> Any:
    """The arguments of a command.  Raises ConfigError for a flag with a former name or of another problem's section."""
    kind, prog = COMMANDS[name][0], f"icrl-dist {name}"
    for option in (word.partition("=")[0] for word in words):
        if option in _RENAMED.get(name, {}):
            raise ConfigError(f"{option} is now called {_RENAMED[name][option]}: rename it")
    if kind is TrainArguments:
        _check_settings(words, run_type(None))
    found: Any = help_text.cli(kind, prog=prog, args=list(words))
    if isinstance(found, TrainArguments) and (found.run or found.source):
        # Once more: flags override the numbers of RUN or, if only --from is given, those of the other run.
        folder = run_folder_of(found.run) if found.resume or found.resume_or_begin else None
        if not found.run:
            folder = parse_source(found.source or "")[0]
        base = load(found.run) if folder is None else load_folder(folder)
        if "--problem" in (word.partition("=")[0] for word in words):
            base = with_problem(base, found.config.problem)
        _check_settings(words, type(base), base.problem)
        return help_text.cli(
            kind, prog=prog, args=list(words), default=TrainArguments(run=found.run, given=tuple(words), config=base)
        )
    return found


def _check_settings(words: Sequence[str], kind: type[Run], problem: str = "") -> None:
    """Check the names in flags ``--SECTION.NAME`` as those in a run file.  Raises ConfigError with the flag."""
    for flag in (word.partition("=")[0] for word in words if word.startswith("--")):
        section, dot, key = flag.removeprefix("--").replace("-", "_").partition(".")
        if dot:
            former_names.check({section: {key: None}}, names_of(kind), problem, flag)


class _Console(PlainConsole):
    def on_broken_pipe(self) -> None:
        raise BrokenPipeError  # for ``main``; rich would exit with code 1


def main(words: Sequence[str] | None = None) -> int:
    """Run ``icrl-dist`` with these words (default: ``sys.argv``).  Returns the exit code.

    If the reader of standard output has closed it, as ``head`` does, the command ends without a message.
    """
    streams.prepare()
    _write_any_text()
    try:
        try:
            return _run(list(sys.argv[1:] if words is None else words))
        finally:
            sys.stdout.flush()  # else Python would find a closed pipe only when it exits
    except BrokenPipeError:
        return streams.end_of_output()


def _write_any_text() -> None:
    """Let the streams write names that their encoding lacks as escapes: with LANG=C, and file names that are not UTF-8."""
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper) and stream.errors == "strict":
            stream.reconfigure(errors="backslashreplace")


def _run(words: list[str]) -> int:
    os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")  # idle torch threads sleep, also in child processes: decision 073
    if isinstance(sys.stdout, io.TextIOWrapper):  # a terminal without UTF-8 cannot show every printable character
        sys.stdout.reconfigure(errors="backslashreplace")
    to_stderr = "--json" in words
    terminal = (sys.stderr if to_stderr else sys.stdout).isatty()
    console = _Console(stderr=to_stderr, width=None if terminal else 120, soft_wrap=not terminal)
    if not words or words[0] in ("--help", "-h"):
        print(_help())
        return OK if words else USAGE
    if words[0] == "--version":
        from icrl_dist import __version__

        print(__version__)
        return OK
    if words[0] not in COMMANDS:
        print(f"icrl-dist: no command {words[0]!r}; choose one of {', '.join(COMMANDS)}", file=sys.stderr)
        return USAGE
    try:
        Path.cwd()
    except OSError as error:
        print(f"icrl-dist: the current folder cannot be used ({error.strerror}): change to another one", file=sys.stderr)
        return USAGE
    try:
        with interruptible():
            return COMMANDS[words[0]][1](_parse(words[0], words[1:]), console)
    except KeyboardInterrupt:
        if words[0] == "train":  # before the run began, or after it ended
            console.print("interrupted", highlight=False)
        return INTERRUPTED
    except Exception as error:
        from icrl_dist.storage.files import explained

        explanation = explained(error)
        code = _code(explanation)
        if code is None:
            raise
        print(f"icrl-dist: {plain(' '.join(str(explanation).split()), 4_000)}", file=sys.stderr)
        return code


def _code(error: Exception) -> int | None:
    """Exit code of an error whose message explains it; None for a bug, whose traceback is printed."""
    from icrl_dist.storage.files import StoreError
    from icrl_dist.stream.link import LinkError, Unanswered

    if isinstance(error, (ConfigError, LinkError)):
        return USAGE
    from icrl_dist.launch.learner_process import TrainFailed

    return FAILED if isinstance(error, (TrainFailed, StoreError, Unanswered)) else None


if __name__ == "__main__":
    sys.exit(main())
