"""The command line: ``icrl-dist COMMAND``.

Exit codes: 0 done, 1 the run failed, 2 bad usage or config, 130 interrupted with a
checkpoint written.
"""

from __future__ import annotations

import contextlib
import dataclasses
import json
import signal
import sys
import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro
from rich.console import Console

from icrl_dist.config import ConfigError, Run, load, validate

OK, FAILED, USAGE, INTERRUPTED = 0, 1, 2, 130


@dataclass(frozen=True)
class Train:
    """Run a method from its first trajectory to its evaluation on held-out tasks.

    RUN is a packaged run (demo, smoke, darkroom) or the path of a TOML file.  Every number of
    the run can be overridden: ``icrl-dist train demo --method icag --adversary.count 4``.
    """

    run: tyro.conf.Positional[str]
    """Name of a packaged run, or path of a run file."""
    engine: Literal["ray", "inline"] = "ray"
    """``ray``: a learner process and Ray workers; ``inline``: all in this process, same results."""
    address: str | None = None
    """Address of a Ray cluster to take workers from; without it Ray starts here."""
    actors: int = 2
    """Workers."""
    out: Path | None = None
    """Run folder; runs/RUN if not given."""
    resume: bool = False
    """Go on with the run in the folder from its last checkpoint."""
    overwrite: bool = False
    """Delete the run in the folder first."""
    json: bool = False
    """Print the result as one JSON object on the last line."""
    config: Annotated[Run, tyro.conf.arg(name="")] = field(default_factory=Run)


@dataclass(frozen=True)
class Evaluate:
    """Deploy a trained agent on tasks it never trained on, beside T^0, a random policy and the oracle."""

    what: tyro.conf.Positional[Path]
    """A run folder, or a checkpoint file."""
    suite: Literal["online", "offline"] = "online"
    """``online``: episode after episode from an empty context; ``offline``: one episode given a
    random or an expert one (Algorithm 1)."""
    deploy: Literal["paper"] = "paper"
    """``paper``: Algorithm 1, the context frozen within an episode."""
    episodes: int | None = None
    """Online episodes; the run's own number if not given."""
    seeds: int | None = None
    """Evaluations of every task; the run's own number if not given."""
    p: tuple[float, ...] = ()
    """Override probabilities to test; the run's own if none are given."""
    prior: Literal["uniform", "unseen"] | None = None
    """Law of the test adversary; the run's own if not given."""
    json: bool = False
    """Print one JSON object on the last line."""


@dataclass(frozen=True)
class Tap:
    """Print one JSON line a trajectory, live, from the monitor plane of a run that is on.

    Nothing that a tap does can slow the run: what it cannot take in time is dropped.
    """

    what: tyro.conf.Positional[Path | None] = None
    """Run folder to listen to; the newest under runs/ if neither this nor --connect is given."""
    connect: str | None = None
    """Endpoint of a learner, such as tcp/127.0.0.1:7447."""
    count: int = 0
    """End after so many lines; 0 goes on until Ctrl-C."""
    timeout: float = 30.0
    """Seconds to wait for the learner."""


@dataclass(frozen=True)
class Bench:
    """Measure one part of the system on this machine, beside what it is compared with."""

    name: tyro.conf.Positional[Literal["env", "stream"]]
    """``env``: environment steps a second; ``stream``: trajectories a second through the stream
    and, in the same run, as Ray actor returns."""
    problem: str = "darkroom"
    """Which environment (env only)."""
    seconds: float | None = None
    """How long to measure."""
    json: bool = False
    """Print one JSON object on the last line."""


@dataclass(frozen=True)
class Doctor:
    """Check this machine: versions, cores, memory, ports, folders; one line and a remedy each."""

    endpoint: str = "tcp/127.0.0.1:0"
    """Where a learner would listen."""
    folder: Path = Path("runs")
    """Where run folders would be made."""


def train(arguments: Train, console: Console) -> int:
    """``icrl-dist train``: both programs to their end, then the evaluation."""
    from actors.fleet import check_cores
    from icrl_dist import heldout, launch
    from icrl_dist.terminal import Display

    run = arguments.config
    validate(run, arguments.run)
    folder = (arguments.out or Path("runs") / Path(arguments.run).stem).absolute()
    if arguments.actors < 1:
        raise ConfigError(f"--actors {arguments.actors}: at least 1 worker is needed")
    if arguments.engine == "ray" and arguments.address is None:
        check_cores(arguments.actors)
    launch.prepare(run, folder, arguments.resume, arguments.overwrite)
    began = time.monotonic()
    try:
        with Display(console) as display:
            if arguments.engine == "inline":
                result = launch.train_inline(run, folder, display.report)
            else:
                result = launch.train_ray(run, folder, arguments.actors, arguments.address, display.report)
            results = heldout.online(run, folder, display)
    except launch.TrainInterrupted:
        console.print(f"interrupted; `icrl-dist train {arguments.run} --resume` goes on from the checkpoint", markup=False)
        return INTERRUPTED
    result |= {"folder": str(folder), "seconds": round(time.monotonic() - began, 1)}
    result |= heldout.show_online(run, folder, results, console)
    (folder / "result.json").write_text(json.dumps(result, indent=1) + "\n")
    console.print(
        f"dataset {result['dataset_digest'][:16]}  weights {result['weights_digest'][:16]}  {result['trajectories']} "
        f"trajectories, {result['seconds']:.0f} s, run folder {folder}",
        highlight=False,
        markup=False,
    )
    if arguments.json:
        print(json.dumps(result))
    return OK


def evaluate(arguments: Evaluate, console: Console) -> int:
    """``icrl-dist evaluate``: per-episode returns beside the oracle's."""
    from icrl_dist import heldout
    from icrl_dist.agent import checkpoint_file
    from icrl_dist.config import parse
    from icrl_dist.store import load_checkpoint
    from icrl_dist.terminal import Display

    checkpoint = load_checkpoint(checkpoint_file(arguments.what))
    run = parse(str(checkpoint.manifest.get("run", "")), str(arguments.what))
    given = {name: getattr(arguments, name) for name in ("episodes", "seeds", "p", "prior")}
    chosen = {name: value for name, value in given.items() if value not in (None, ())}
    run = dataclasses.replace(run, evaluate=dataclasses.replace(run.evaluate, **chosen))
    validate(run, "evaluate")
    answer: dict[str, Any] = {"suite": arguments.suite, "deploy": arguments.deploy, "what": str(arguments.what)}
    if arguments.suite == "online":
        with Display(console) as display:
            results = heldout.online(run, arguments.what, display)
        answer |= heldout.show_online(run, arguments.what, results, console)
    else:
        answer |= heldout.show_offline(heldout.offline(run, arguments.what), console)
    if arguments.json:
        print(json.dumps(answer))
    return OK


def tap(arguments: Tap, console: Console) -> int:
    """``icrl-dist tap``: a JSON line a trajectory."""
    from icrl_dist.stream import wire
    from icrl_dist.stream.zenoh_link import ZenohLink

    endpoint = arguments.connect or _endpoint(arguments.what)
    left = [arguments.count]
    over = threading.Event()

    def show(key: str, payload: bytes) -> None:
        with contextlib.suppress(wire.WireError):
            _, fields = wire.decode_message(payload)
            if not over.is_set():
                print(json.dumps(fields), flush=True)
                left[0] -= 1
                if left[0] == 0:
                    over.set()

    for name in (signal.SIGINT, signal.SIGTERM):
        signal.signal(name, lambda *_: over.set())
    with ZenohLink.connect(endpoint, timeout_s=arguments.timeout) as link:
        link.subscribe("icrl/*/mon/trajectory/**", show)
        over.wait()
    return OK


def _endpoint(what: Path | None) -> str:
    files = [what / "endpoint"] if what else sorted(Path("runs").glob("*/endpoint"), key=lambda f: f.stat().st_mtime)
    if not files or not files[-1].is_file():
        raise ConfigError(
            f"no run is on in {what or 'runs/'}: start one with `icrl-dist train`, or name it with --connect tcp/HOST:PORT"
        )
    return files[-1].read_text().strip()


def bench(arguments: Bench, console: Console) -> int:
    """``icrl-dist bench``: one benchmark."""
    from icrl_dist.bench import env, stream

    timed: dict[str, Any] = {} if arguments.seconds is None else {"seconds": arguments.seconds}
    if arguments.name == "env":
        result, text = (r := env.run(arguments.problem, **timed)), env.describe(r)
    else:
        result, text = (r := stream.run(**timed)), stream.describe(r)
    console.print(text, highlight=False, markup=False)
    if arguments.json:
        print(json.dumps(result))
    return OK


def doctor(arguments: Doctor, console: Console) -> int:
    """``icrl-dist doctor``: exit code 1 if anything would stop a run."""
    from icrl_dist.doctor import diagnose, table

    findings = diagnose(arguments.endpoint, arguments.folder)
    console.print(table(findings), highlight=False, markup=False)
    return FAILED if any(finding.ok is False for finding in findings) else OK


COMMANDS: dict[str, tuple[type, Callable[[Any, Console], int]]] = {
    "train": (Train, train),
    "evaluate": (Evaluate, evaluate),
    "tap": (Tap, tap),
    "bench": (Bench, bench),
    "doctor": (Doctor, doctor),
}


def _help() -> str:
    lines = ["icrl-dist: robust in-context reinforcement learning, distributed", "", "usage: icrl-dist COMMAND ...", ""]
    lines += [f"  {name:<10} {(kind.__doc__ or '').splitlines()[0]}" for name, (kind, _) in COMMANDS.items()]
    return "\n".join([*lines, "", "`icrl-dist COMMAND --help` explains a command; begin with `icrl-dist train demo`."])


def _parse(name: str, arguments: Sequence[str]) -> Any:
    kind = COMMANDS[name][0]
    default: Any = None
    if kind is Train:
        words = [a for a in arguments if not a.startswith("-")]
        named = next((w for w in words if w.endswith(".toml")), words[0] if words else None)
        if named is not None and not {"--help", "-h"} & set(arguments):
            default = Train(run=named, config=load(named))
    return tyro.cli(kind, prog=f"icrl-dist {name}", args=list(arguments), **({"default": default} if default else {}))


def main(arguments: Sequence[str] | None = None) -> int:
    """The ``icrl-dist`` command.  Returns its exit code."""
    words = list(sys.argv[1:] if arguments is None else arguments)
    to_stderr = "--json" in words
    terminal = (sys.stderr if to_stderr else sys.stdout).isatty()
    console = Console(stderr=to_stderr, width=None if terminal else 120, soft_wrap=not terminal)
    if not words or words[0] in ("--help", "-h"):
        print(_help())
        return OK if words else USAGE
    if words[0] == "--version":
        from icrl_dist import __version__

        print(__version__)
        return OK
    if words[0] not in COMMANDS:
        print(f"icrl-dist: no command {words[0]!r}; there are {', '.join(COMMANDS)}", file=sys.stderr)
        return USAGE
    try:
        return COMMANDS[words[0]][1](_parse(words[0], words[1:]), console)
    except KeyboardInterrupt:
        return INTERRUPTED
    except Exception as error:
        code = _code(error)
        if code is None:
            raise
        print(f"icrl-dist: {' '.join(str(error).split())}", file=sys.stderr)
        return code


def _code(error: Exception) -> int | None:
    """The exit code of an error that its message explains; None for a bug, which keeps its trace."""
    from icrl_dist.store import StoreError
    from icrl_dist.stream.link import LinkError, Unanswered

    if isinstance(error, (ConfigError, LinkError)):
        return USAGE
    from icrl_dist.launch import TrainFailed

    return FAILED if isinstance(error, (TrainFailed, StoreError, Unanswered)) else None


if __name__ == "__main__":
    sys.exit(main())
