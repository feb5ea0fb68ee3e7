"""What each command of the command line does with its arguments; returns the exit code."""

from __future__ import annotations

import contextlib
import dataclasses
import json
import signal
import threading
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rich.console import Console

from icrl_dist.config import ConfigError, load, override, validate
from icrl_dist.lineage import parse_source
from icrl_dist.types import Identity

if TYPE_CHECKING:
    from icrl_dist.cli import Bench, Chaos, Doctor, Evaluate, Explain, Export, Tap, Train

OK, FAILED, USAGE, INTERRUPTED = 0, 1, 2, 130


def train(arguments: Train, console: Console) -> int:
    """``icrl-dist train``: both programs to their end, then the evaluation."""
    from actors.fleet import check_cores
    from icrl_dist import heldout, launch
    from icrl_dist.agent import checkpoint_file
    from icrl_dist.files import atomic_write, save_checkpoint
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
            if run.method != "experts":
                save_checkpoint(checkpoint_file(folder), heldout.calibrate(folder, display))
                results = heldout.online(run, folder, display)
    except launch.TrainInterrupted:
        given = arguments.run or f"--from {arguments.source}"
        console.print(f"interrupted; `icrl-dist train {given} --resume` goes on from the checkpoint", markup=False)
        return INTERRUPTED
    result |= {"folder": str(folder), "seconds": round(time.monotonic() - began, 1)}
    if run.method == "experts":
        result |= heldout.show_experts(folder, console)
    else:
        result |= heldout.show_online(run, folder / "report", *results, console)
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
    from icrl_dist.config import default_deployment, parse
    from icrl_dist.files import load_checkpoint
    from icrl_dist.terminal import Display

    what, folder = _evaluated(arguments)
    checkpoint = load_checkpoint(checkpoint_file(what))
    run = parse(str(checkpoint.manifest.get("run", "")), str(what))
    given = {name: getattr(arguments, name) for name in ("episodes", "seeds", "p", "prior")}
    chosen = {name: value for name, value in given.items() if value not in (None, ())}
    if arguments.suite == "posterior":
        chosen = {"p": (0.0, 0.2, 0.4, 0.6), "prior": "uniform", "episodes": 40, "seeds": 2} | chosen
    run = dataclasses.replace(run, evaluate=dataclasses.replace(run.evaluate, **chosen))
    validate(run, "evaluate")
    if run.problem != "darkroom" and arguments.suite != "online":
        raise ConfigError(f"--suite {arguments.suite}: only Dark Room has that so far; {run.problem} has --suite online")
    deploy = "paper" if arguments.suite == "posterior" else arguments.deploy or default_deployment(run.model)
    answer: dict[str, Any] = {"suite": arguments.suite, "deploy": deploy, "what": str(what)}
    if arguments.suite == "online":
        with Display(console) as display:
            results = heldout.online(run, what, display, arguments.deploy)
        answer |= heldout.show_online(run, folder, *results, console)
    elif arguments.suite == "posterior":
        with Display(console) as display:
            report = heldout.posterior(run, what, display)
        answer |= heldout.show_posterior(run, folder, report, console)
    else:
        answer |= heldout.show_offline(heldout.offline(run, what, arguments.deploy), console)
    if arguments.json:
        print(json.dumps(answer))
    return OK


def _evaluated(arguments: Evaluate) -> tuple[Path, Path]:
    """What is to be evaluated, and the folder of its report."""
    from icrl_dist.agent import shipped

    what, name = arguments.what, arguments.pretrained
    if what is not None and name is None:
        return what, (what if what.is_dir() else what.parent) / "report"
    if what is None and name is not None:
        return shipped(name), Path("runs") / f"{name}-pretrained" / "report"
    raise ConfigError("evaluate: name a run folder or a checkpoint file, or with --pretrained an agent that is shipped")


def export(arguments: Export, console: Console) -> int:
    """``icrl-dist export``: an agent without what only training needs."""
    from icrl_dist import heldout
    from icrl_dist.agent import checkpoint_file, slim
    from icrl_dist.files import save_checkpoint
    from icrl_dist.terminal import Display

    source = checkpoint_file(arguments.what)
    out = arguments.out or (arguments.what if arguments.what.is_dir() else source.parent) / "agent.npz"
    if out.is_dir():
        raise ConfigError(f"--out {out}: is a folder; name a file, such as {out / 'agent.npz'}")
    with Display(console) as display:
        save_checkpoint(out, slim(heldout.calibrate(source, display)))
    console.print(f"{out}: {out.stat().st_size / 1000:.0f} kB, for icrl_dist.load_agent", highlight=False, markup=False)
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
    from icrl_dist.bench import bite, broadcast, disturbance, env, experts, fuzz, incontext, ingest, recovery, soak, stream

    if arguments.seconds is not None and arguments.name in (
        "broadcast",
        "disturbance",
        "experts",
        "fuzz",
        "incontext",
        "recovery",
    ):
        raise ConfigError(f"bench {arguments.name}: --seconds: it takes as long as it takes; leave it out")
    if (arguments.name != "disturbance" or arguments.quick) and arguments.bite is not None:
        raise ConfigError(f"--bite {arguments.bite:g}: it belongs to `bench disturbance`, without --quick")
    if arguments.bite is None and arguments.steps is not None:
        raise ConfigError(f"--steps {arguments.steps}: it belongs to `bench disturbance --bite`")
    timed: dict[str, Any] = {} if arguments.seconds is None else {"seconds": arguments.seconds}
    match arguments.name:
        case "env":
            result, text = (r := env.run(arguments.problem or "darkroom", **timed)), env.describe(r)
        case "stream":
            result, text = (r := stream.run(**timed)), stream.describe(r)
        case "ingest":
            result, text = (r := ingest.run(arguments.folder, **timed)), ingest.describe(r)
        case "broadcast":
            result, text = (r := broadcast.run()), broadcast.describe(r)
        case "recovery":
            result, text = (r := recovery.run(arguments.folder)), recovery.describe(r)
        case "soak":
            with console.status("soak") as status:
                show = lambda elapsed, said: status.update(f"soak: {elapsed:.0f} s, {said}")  # noqa: E731
                result = soak.run(folder=arguments.folder, report=show, **timed)
            text = soak.describe(result)
        case "fuzz":
            result, text = (r := fuzz.run(folder=arguments.folder)), fuzz.describe(r)
        case "incontext":
            with console.status("incontext") as status:
                result = incontext.run(arguments.folder, arguments.quick, lambda said: status.update(f"incontext: {said}"))
            text = incontext.describe(result)
        case "experts":
            with console.status("experts"):
                result = experts.run(arguments.quick)
            text = experts.describe(result)
        case "disturbance":
            say = lambda said: console.print(said, highlight=False, markup=False)  # noqa: E731
            if arguments.bite is None:
                text = disturbance.describe(result := disturbance.run(arguments.problem, arguments.quick, say))
            else:
                text = bite.describe(result := bite.run(arguments.bite, arguments.problem, arguments.steps, say))
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
