"""What each command of the command line does with its arguments; returns the exit code."""

from __future__ import annotations

import contextlib
import dataclasses
import json
import os
import shlex
import signal
import sys
import threading
import time
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rich.console import Console

from icrl_dist.config.run import ConfigError, load, override, validate
from icrl_dist.storage.fork import parse_source
from icrl_dist.types import Identity

if TYPE_CHECKING:
    from icrl_dist.cli.arguments import Chaos, Doctor, Evaluate, Explain, Export, Monitor, Plan, Play, Tap, Train

OK, FAILED, USAGE, INTERRUPTED = 0, 1, 2, 130
UNREAD = 128 + signal.SIGPIPE
"""As a shell tells it of a command that nobody read to its end."""
LOCAL_ACTORS = 2
"""Workers on one machine, if nobody says how many."""


def train(arguments: Train, console: Console) -> int:
    """``icrl-dist train``: both programs to their end, then the evaluation."""
    from actors.fleet import check_cores
    from icrl_dist.console.terminal import Display
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


def evaluate(arguments: Evaluate, console: Console) -> int:
    """``icrl-dist evaluate``: per-episode returns beside the oracle's."""
    from icrl_dist.agent.in_context_agent import checkpoint_file
    from icrl_dist.config.run import default_deployment, parse
    from icrl_dist.console.terminal import Display
    from icrl_dist.results import heldout
    from icrl_dist.storage.checkpoint import load_checkpoint

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
    report = folder / heldout.report_name(run, what, arguments.suite, deploy)
    if arguments.suite == "online":
        with Display(console) as display:
            results = heldout.online(run, what, display, arguments.deploy)
        answer |= heldout.show_online(run, report, *results, console)
    elif arguments.suite == "posterior":
        with Display(console) as display:
            found = heldout.posterior(run, what, display)
        answer |= heldout.show_posterior(run, report, found, console)
    else:
        answer |= heldout.show_offline(heldout.offline(run, what, arguments.deploy), console)
    if arguments.json:
        print(json.dumps(answer))
    return OK


def _evaluated(arguments: Evaluate) -> tuple[Path, Path]:
    """What is to be evaluated, and the folder of its report."""
    from icrl_dist.agent.in_context_agent import shipped

    what, name = arguments.what, arguments.pretrained
    if what is not None and name is None:
        return what, (what if what.is_dir() else what.parent) / "report"
    if what is None and name is not None:
        return shipped(name), Path("runs") / f"{name}-pretrained" / "report"
    raise ConfigError("evaluate: name a run folder or a checkpoint file, or with --pretrained an agent that is shipped")


def export(arguments: Export, console: Console) -> int:
    """``icrl-dist export``: an agent without what only training needs."""
    from icrl_dist.agent.in_context_agent import checkpoint_file, is_slim, slim
    from icrl_dist.console.terminal import Display
    from icrl_dist.results import heldout
    from icrl_dist.storage.checkpoint import save_checkpoint

    source = checkpoint_file(arguments.what)
    out = arguments.out or (arguments.what if arguments.what.is_dir() else source.parent) / "agent.npz"
    if out.is_dir():
        raise ConfigError(f"--out {out}: is a folder; name a file, such as {out / 'agent.npz'}")
    if out.exists() and not is_slim(out):
        raise ConfigError(f"--out {out}: exists, and is no agent that was exported; name another file")
    with Display(console) as display:
        save_checkpoint(out, slim(heldout.calibrate(source, display)))
    console.print(f"{out}: {out.stat().st_size / 1000:.0f} kB, for icrl_dist.load_agent", highlight=False, markup=False)
    return OK


def monitor(arguments: Monitor, console: Console) -> int:
    """``icrl-dist monitor``: the live view."""
    from icrl_dist.monitor.feed import LiveFeed, ReplayFeed
    from icrl_dist.stream import security
    from icrl_dist.stream.zenoh_link import ZenohLink

    if arguments.speed <= 0:
        raise ConfigError(f"--speed {arguments.speed:g}: must be above 0")
    if arguments.web is None and not all(stream.isatty() for stream in (sys.stdin, sys.stdout, sys.stderr)):
        raise ConfigError("monitor: no terminal here; --web PORT serves it as a page, `icrl-dist tap` prints a JSON line each")
    what = arguments.what
    with contextlib.ExitStack() as stack:
        if what is not None and not arguments.connect and not _on(what, console):
            feed: LiveFeed | ReplayFeed = stack.enter_context(ReplayFeed(what, arguments.speed))
        else:
            endpoint, certificates, run = _learner(what, arguments.connect, arguments.certificates)
            settings = security.client(certificates, "monitor")
            link = stack.enter_context(ZenohLink.connect(endpoint, arguments.timeout, settings))
            feed = stack.enter_context(LiveFeed(link, run))
        if arguments.web is not None:
            from icrl_dist.monitor.page import serve

            return serve(feed, arguments.host, arguments.web, console)
        from icrl_dist.monitor.screen import watch

        return watch(feed)


def tap(arguments: Tap, console: Console) -> int:
    """``icrl-dist tap``: a JSON line a trajectory."""
    from icrl_dist.monitor.tap import Tapped
    from icrl_dist.stream import security
    from icrl_dist.stream.zenoh_link import ZenohLink

    endpoint, certificates, run = _learner(arguments.what, arguments.connect, arguments.certificates)
    over = threading.Event()
    tapped = Tapped(arguments.task, arguments.adversary, arguments.every, arguments.format, arguments.count, over.set)
    for name in (signal.SIGINT, signal.SIGTERM):
        signal.signal(name, lambda *_: over.set())
    with ZenohLink.connect(endpoint, arguments.timeout, security.client(certificates, "monitor")) as link:
        link.subscribe(f"icrl/{run or '*'}/mon/trajectories/**", tapped)
        over.wait()
    if tapped.error is None:
        return OK
    os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())  # what was not written is not tried again at the end
    if isinstance(tapped.error, BrokenPipeError):
        return UNREAD
    print(f"icrl-dist: tap: standard output cannot be written: {tapped.error.strerror}", file=sys.stderr)
    return FAILED


def _on(folder: Path, console: Console) -> bool:
    """Whether a run folder's learner is there; a crash may have left its endpoint behind, which is said."""
    from icrl_dist.storage.files import held

    if not (folder / "endpoint").is_file():
        return False
    if held(folder):
        return True
    told = "its learner is gone without a word, the run is played again; --connect ENDPOINT watches one on another machine"
    console.print(f"{folder}: {told}", highlight=False, markup=False)
    return False


def _learner(what: Path | None, connect: str | None, certificates: str | None) -> tuple[str, str, str]:
    """Where the learner is reached that a run folder or ``--connect`` means, the certificates to show it, and its run.

    The run's name is empty where only the endpoint says which it is.
    """
    from icrl_dist.storage.files import held

    if connect:
        if not certificates and connect.startswith("tls/"):
            raise ConfigError(
                f"--connect {connect}: TLS needs --certificates, a folder with ca.pem, monitor.pem and monitor.key"
            )
        return connect, certificates or "", ""
    files = [what / "endpoint"] if what else sorted(Path("runs").glob("[!.]*/endpoint"), key=lambda f: f.stat().st_mtime)
    files = [file for file in files if held(file.parent)] or files  # a crash leaves its endpoint behind
    if not files or not files[-1].is_file():
        raise ConfigError(
            f"no run is on in {what or 'runs/'}: start one with `icrl-dist train`, or name it with --connect tcp/HOST:PORT"
        )
    folder = files[-1].parent
    stream = load(str(folder / "run.toml")).stream
    endpoint = stream.connect or files[-1].read_text().strip()
    return endpoint, certificates or stream.certificates, _name(folder)


def _name(folder: Path) -> str:
    """The name of the run in a folder; empty where a link gives the folder two, of which its learner goes by either."""
    name = folder.absolute().name
    return name if folder.resolve().name == name else ""


def explain(arguments: Explain, console: Console) -> int:
    """``icrl-dist explain``: one trajectory's origin, or the whole ledger."""
    from icrl_dist.diagnostics import explain as explaining

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
    from icrl_dist.chaos.training import TrainingFailed
    from icrl_dist.launch.learner_process import TrainFailed

    given = arguments
    if given.seeds < 1 or given.actors < 1:
        raise ConfigError(f"--seeds {given.seeds} --actors {given.actors}: at least 1 of each is needed")
    seeds = range(given.seed, given.seed + given.seeds)
    with Campaign(given.run, given.set, given.actors, given.out, console) as campaign:
        try:
            answer = campaign.run(given.faults, seeds, given.reference)
        except TrainingFailed as error:
            raise TrainFailed(f"undisturbed: {error}") from None
    if given.json:
        print(json.dumps(answer))
    return OK if answer["ok"] else FAILED


def play(arguments: Play, console: Console) -> int:
    """``icrl-dist play``: until Ctrl-C."""
    from icrl_dist.agent.in_context_agent import shipped
    from icrl_dist.monitor import player

    what = arguments.what if arguments.pretrained is None else shipped(arguments.pretrained)
    if what is None or (arguments.what and arguments.pretrained):
        raise ConfigError("play: name a run folder or a checkpoint file, or --pretrained darkroom")
    player.play(what, (arguments.host, arguments.web), arguments.deploy, arguments.seed, arguments.paused, console)
    return OK


def doctor(arguments: Doctor, console: Console) -> int:
    """``icrl-dist doctor``: exit code 1 if anything would stop a run."""
    from icrl_dist.diagnostics.doctor import diagnose, diagnose_cluster, diagnose_file, table

    if arguments.cluster is not None:
        findings = diagnose_file(arguments.cluster, Path())
    elif arguments.address is not None:
        findings = diagnose_cluster(arguments.address, arguments.endpoint, arguments.certificates)
    else:
        findings = diagnose(arguments.endpoint, arguments.folder)
    console.print(table(findings), highlight=False, markup=False)
    return FAILED if any(finding.ok is False for finding in findings) else OK


def plan(arguments: Plan, console: Console) -> int:
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
