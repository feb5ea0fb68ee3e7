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

from icrl_dist.config import ConfigError, Run, load, override, validate
from icrl_dist.lineage import parse_source
from icrl_dist.types import Identity

OK, FAILED, USAGE, INTERRUPTED = 0, 1, 2, 130


@dataclass(frozen=True)
class Train:
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
    actors: int = 2
    """Workers."""
    oversubscribe: bool = False
    """Allow more workers than cores: slower, and the same results."""
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
    certificates: str | None = None
    """Folder with ca.pem, monitor.pem and monitor.key, for a learner at tls/; the run's own if
    not given."""
    count: int = 0
    """End after so many lines; 0 goes on until Ctrl-C."""
    timeout: float = 30.0
    """Seconds to wait for the learner."""


@dataclass(frozen=True)
class Bench:
    """Measure one part of the system on this machine, beside what it is compared with."""

    name: tyro.conf.Positional[Literal["env", "stream", "ingest", "broadcast", "fuzz"]]
    """``env``: environment steps a second; ``stream``: trajectories a second through the stream
    and, in the same run, as Ray actor returns; ``ingest``: trajectories a second onto the disk, with
    and without fsync; ``broadcast``: weights to eight processes, beside ``ray.put`` and ``get``;
    ``fuzz``: 100,000 hostile inputs to every reader of bytes."""
    problem: str = "darkroom"
    """Which environment (env only)."""
    seconds: float | None = None
    """How long to measure (env, stream and ingest)."""
    folder: Path = Path("runs")
    """Whose disk to write to (ingest), where to keep an input that breaks something (fuzz)."""
    json: bool = False
    """Print one JSON object on the last line."""


@dataclass(frozen=True)
class Explain:
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


@dataclass(frozen=True)
class Chaos:
    """Disturb a small job on a seeded schedule: every digest must equal the undisturbed run's.

    RUN is run once undisturbed, then once for each fault: kill-worker, kill-learner and
    kill-tree (SIGKILL), stop-learner (SIGSTOP for 15 s), cut-link (12 s of silence), torn-tail
    and flip-byte (a damaged dataset), full-disk (needs root, or user namespaces).  A fault that
    did not land, for nothing died, was sent again or was repaired, fails the command as another
    digest does.  ``icrl-dist chaos smoke`` takes some minutes on two cores.
    """

    run: tyro.conf.Positional[str] = "smoke"
    """Name of a packaged run, or path of a run file."""
    set: tyro.conf.UseAppendAction[tuple[str, ...]] = ()
    """SECTION.NAME=VALUE, as in icaa.trials=60; may be given many times."""
    seeds: int = 1
    """Schedules to run: each strikes elsewhere."""
    seed: int = 0
    """The first schedule's seed."""
    faults: str = ""
    """Some of the faults, such as kill-worker,torn-tail; all if not given."""
    actors: int = 2
    """Workers."""
    out: Path = Path("runs/chaos")
    """Where run folders and logs are made; those of faults that changed nothing are removed."""
    reference: Path | None = None
    """Folder of a finished run with the same numbers, to compare with instead of running it."""
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
    from icrl_dist.files import atomic_write
    from icrl_dist.terminal import Display

    if not arguments.run and not arguments.source:
        raise ConfigError("train: name a RUN, such as demo, or another run to go on from with --from RUN_DIR@ROUND")
    source = parse_source(arguments.source) if arguments.source else None
    name = Path(arguments.run).stem or f"{source[0].name}-from-{source[1]}" if source else Path(arguments.run).stem
    run = override(arguments.config, arguments.set, "--set")
    validate(run, arguments.run or str(arguments.source))
    folder = (arguments.out or Path("runs") / name).absolute()
    if arguments.actors < 1:
        raise ConfigError(f"--actors {arguments.actors}: at least 1 worker is needed")
    if arguments.engine == "ray" and arguments.address is None and not arguments.oversubscribe:
        check_cores(arguments.actors)
    if arguments.engine == "ray":
        launch.check_security(run, arguments.address)
    launch.prepare(run, folder, arguments.resume, arguments.overwrite, source)
    began = time.monotonic()
    try:
        with Display(console) as display:
            if arguments.engine == "inline":
                result = launch.train_inline(run, folder, display.report)
            else:
                result = launch.train_ray(
                    run, folder, arguments.actors, arguments.address, display.report, arguments.oversubscribe
                )
            results = heldout.online(run, folder, display)
    except launch.TrainInterrupted:
        given = arguments.run or f"--from {arguments.source}"
        console.print(f"interrupted; `icrl-dist train {given} --resume` goes on from the checkpoint", markup=False)
        return INTERRUPTED
    result |= {"folder": str(folder), "seconds": round(time.monotonic() - began, 1)}
    result |= heldout.show_online(run, folder, results, console)
    atomic_write(folder / "result.json", lambda file: file.write(json.dumps(result, indent=1).encode() + b"\n"))
    console.print(
        f"dataset {result['dataset_digest'][:16]}  weights {result['weights_digest'][:16]}  {result['trajectories']} "
        f"trajectories, {result['seconds']:.0f} s, run folder {folder}",
        highlight=False,
        markup=False,
    )
    if result["staleness"]:
        console.print(f"asynchronous: trajectories by versions behind: {result['lag']}; digests differ from run to run")
    for given_up in result["quarantined"]:
        console.print(f"quarantined: {given_up['variation']}: {given_up['cause']}", highlight=False, markup=False)
    if arguments.json:
        print(json.dumps(result))
    return FAILED if result["quarantined"] else OK


def evaluate(arguments: Evaluate, console: Console) -> int:
    """``icrl-dist evaluate``: per-episode returns beside the oracle's."""
    from icrl_dist import heldout
    from icrl_dist.agent import checkpoint_file
    from icrl_dist.config import parse
    from icrl_dist.files import load_checkpoint
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
    from icrl_dist.stream import security, wire
    from icrl_dist.stream.zenoh_link import ZenohLink

    endpoint, certificates = _learner(arguments.what, arguments.connect, arguments.certificates)
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
    with ZenohLink.connect(endpoint, arguments.timeout, security.client(certificates, "monitor")) as link:
        link.subscribe("icrl/*/mon/trajectory/**", show)
        over.wait()
    return OK


def _learner(what: Path | None, connect: str | None, certificates: str | None) -> tuple[str, str]:
    """Where the learner is reached that a run folder or ``--connect`` means, and the certificates to show it."""
    if connect:
        if not certificates and connect.startswith("tls/"):
            raise ConfigError(
                f"--connect {connect}: TLS needs --certificates, a folder with ca.pem, monitor.pem and monitor.key"
            )
        return connect, certificates or ""
    files = [what / "endpoint"] if what else sorted(Path("runs").glob("*/endpoint"), key=lambda f: f.stat().st_mtime)
    if not files or not files[-1].is_file():
        raise ConfigError(
            f"no run is on in {what or 'runs/'}: start one with `icrl-dist train`, or name it with --connect tcp/HOST:PORT"
        )
    stream = load(str(files[-1].with_name("run.toml"))).stream
    return stream.connect or files[-1].read_text().strip(), certificates or stream.certificates


def bench(arguments: Bench, console: Console) -> int:
    """``icrl-dist bench``: one benchmark."""
    from icrl_dist.bench import broadcast, env, fuzz, ingest, stream

    if arguments.seconds is not None and arguments.name in ("broadcast", "fuzz"):
        raise ConfigError(f"bench {arguments.name}: --seconds: it takes as long as it takes; leave it out")
    timed: dict[str, Any] = {} if arguments.seconds is None else {"seconds": arguments.seconds}
    match arguments.name:
        case "env":
            result, text = (r := env.run(arguments.problem, **timed)), env.describe(r)
        case "stream":
            result, text = (r := stream.run(**timed)), stream.describe(r)
        case "ingest":
            result, text = (r := ingest.run(arguments.folder, **timed)), ingest.describe(r)
        case "broadcast":
            result, text = (r := broadcast.run()), broadcast.describe(r)
        case "fuzz":
            result, text = (r := fuzz.run(folder=arguments.folder)), fuzz.describe(r)
    console.print(text, highlight=False, markup=False)
    if arguments.json:
        print(json.dumps(result))
    return OK if result.get("ok", True) else FAILED


def explain(arguments: Explain, console: Console) -> int:
    """``icrl-dist explain``: one trajectory's origin, or the whole ledger."""
    from icrl_dist import explain as explaining

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


def chaos(arguments: Chaos, console: Console) -> int:
    """``icrl-dist chaos``: exit code 1 if a fault did not land or changed a digest."""
    from icrl_dist.chaos.campaign import Campaign
    from icrl_dist.chaos.training import Broken
    from icrl_dist.launch import TrainFailed

    given = arguments
    if given.seeds < 1 or given.actors < 1:
        raise ConfigError(f"--seeds {given.seeds} --actors {given.actors}: at least 1 of each is needed")
    seeds = range(given.seed, given.seed + given.seeds)
    with Campaign(given.run, given.set, given.actors, given.out, console) as campaign:
        try:
            answer = campaign.run(given.faults, seeds, given.reference)
        except Broken as error:
            raise TrainFailed(f"undisturbed: {error}") from None
    if given.json:
        print(json.dumps(answer))
    return OK if answer["ok"] else FAILED


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
    "explain": (Explain, explain),
    "chaos": (Chaos, chaos),
    "doctor": (Doctor, doctor),
}


def _help() -> str:
    lines = ["icrl-dist: robust in-context reinforcement learning, distributed", "", "usage: icrl-dist COMMAND ...", ""]
    lines += [f"  {name:<10} {(kind.__doc__ or '').splitlines()[0]}" for name, (kind, _) in COMMANDS.items()]
    return "\n".join([*lines, "", "`icrl-dist COMMAND --help` explains a command; begin with `icrl-dist train demo`."])


def _parse(name: str, arguments: Sequence[str]) -> Any:
    kind, prog = COMMANDS[name][0], f"icrl-dist {name}"
    found: Any = tyro.cli(kind, prog=prog, args=list(arguments))
    if isinstance(found, Train) and (found.run or found.source):
        # Once more: flags override the numbers of RUN or, if only --from is given, those of the other run.
        base = load(found.run or str(parse_source(found.source or "")[0] / "run.toml"))
        return tyro.cli(kind, prog=prog, args=list(arguments), default=Train(run=found.run, config=base))
    return found


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
        from icrl_dist.files import explained

        told = explained(error)
        code = _code(told)
        if code is None:
            raise
        print(f"icrl-dist: {' '.join(str(told).split())}", file=sys.stderr)
        return code


def _code(error: Exception) -> int | None:
    """The exit code of an error that its message explains; None for a bug, which keeps its trace."""
    from icrl_dist.files import StoreError
    from icrl_dist.stream.link import LinkError, Unanswered

    if isinstance(error, (ConfigError, LinkError)):
        return USAGE
    from icrl_dist.launch import TrainFailed

    return FAILED if isinstance(error, (TrainFailed, StoreError, Unanswered)) else None


if __name__ == "__main__":
    sys.exit(main())
