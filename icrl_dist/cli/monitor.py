"""``icrl-dist monitor`` and ``icrl-dist tap``: views of a run that is on."""

from __future__ import annotations

import contextlib
import os
import signal
import sys
import threading
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import tyro
from rich.console import Console

from icrl_dist.cli.exit_codes import FAILED, OK, UNREAD
from icrl_dist.config.run import ConfigError, load


@dataclass(frozen=True)
class MonitorArguments:
    """Watch a run live, in the terminal or in a browser; or play one again that has ended.

    Without WHAT: the newest run under runs/ that is on.  A view reads the monitor plane only, so
    it can slow nobody down.  ``icrl-dist monitor runs/demo`` plays the run in that folder again
    once it has ended, at any speed.
    """

    what: tyro.conf.Positional[Path | None] = None
    """Run folder: watched if the run is on, played again if it has ended or crashed."""
    connect: str | None = None
    """Instead, the endpoint of a learner, such as tcp/127.0.0.1:7447."""
    certificates: str | None = None
    """Folder with ca.pem, monitor.pem and monitor.key, for a learner at tls/; the run's own if
    not given."""
    web: int | None = None
    """Serve a page at this port instead; 0 takes a free one."""
    host: str = "127.0.0.1"
    """Where the page is served: only to this machine unless you change it."""
    speed: float = 10.0
    """Seconds of then a second, of a run that is played again; the views can change it."""
    timeout: float = 30.0
    """Seconds to wait for the learner."""


def monitor(arguments: MonitorArguments, console: Console) -> int:
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


@dataclass(frozen=True)
class TapArguments:
    """Print one JSON line a trajectory, live, from the monitor plane of a run that is on.

    ``icrl-dist tap --task 3 --adversary dirichlet --every 10`` prints every tenth of those that
    pass both filters.

    Nothing that a tap does can slow the run: what it cannot take in time is dropped.
    """

    what: tyro.conf.Positional[Path | None] = None
    """Run folder to listen to; the newest under runs/ if neither this nor --connect is given."""
    connect: str | None = None
    """Endpoint of a learner, such as tcp/127.0.0.1:7447."""
    certificates: str | None = None
    """Folder with ca.pem, monitor.pem and monitor.key, for a learner at tls/; the run's own if
    not given."""
    task: tuple[int, ...] = ()
    """Only these tasks, by their numbers."""
    adversary: tuple[str, ...] = ()
    """Only these adversaries: numbers of variations, or kinds such as ``dirichlet`` or ``null``."""
    every: int = 1
    """Of those that pass, only every so manyth."""
    format: Literal["json", "msgpack"] = "json"
    """``json``: a line each; ``msgpack``: the same maps one after another, as a msgpack stream."""
    count: int = 0
    """End after so many trajectories; 0 goes on until Ctrl-C."""
    timeout: float = 30.0
    """Seconds to wait for the learner."""


def tap(arguments: TapArguments, console: Console) -> int:
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
