"""``icrl-dist monitor`` and ``icrl-dist tap``: live views of a run."""

from __future__ import annotations

import contextlib
import functools
import os
import sys
import threading
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import tyro
from rich.console import Console

from icrl_dist.cli.exit_codes import FAILED, OK
from icrl_dist.config.run import ConfigError, load_folder
from icrl_dist.console.signals import on_signals


@dataclass(frozen=True)
class MonitorArguments:
    """Watch a run live in the terminal or in a browser, or replay a run that has ended.

    A folder of runs, which may be empty or missing yet: the newest run in it; the page also lists the others,
    and compares two.  Without RUN_DIR: the newest active run under runs/.  A view only reads the monitor plane, so it
    cannot slow the run down.  ``icrl-dist monitor runs/demo`` replays the run in that folder, at any
    speed, if it has ended.
    """

    what: Annotated[tyro.conf.Positional[Path | None], tyro.conf.arg(metavar="[RUN_DIR]")] = None
    """Run folder, or a folder of runs.  An active run is shown live; one that has ended or crashed is replayed."""
    connect: str | None = None
    """Instead, the endpoint of a learner, such as tcp/127.0.0.1:7447."""
    certificates: str | None = None
    """Folder with ca.pem, monitor.pem and monitor.key, for a learner at tls/.  Default: the run's
    folder of certificates."""
    web: int | None = None
    """Serve the view as a web page at this port; 0 chooses a free port."""
    host: str = "127.0.0.1"
    """Address at which the page is served.  The default allows this computer only."""
    speed: float = 10.0
    """Speed of a replay: seconds of the run per second.  It can be changed in the view."""
    timeout: float = 30.0
    """Seconds to wait for a connection to the learner."""


def monitor(arguments: MonitorArguments, console: Console) -> int:
    """Show the view until the user ends it.  Returns the exit code."""
    from icrl_dist.monitor.feed import LiveFeed, ReplayFeed
    from icrl_dist.stream import security
    from icrl_dist.stream.zenoh_link import ZenohLink

    if arguments.speed <= 0:
        raise ConfigError(f"--speed {arguments.speed:g}: must be above 0")
    if arguments.web is None and not all(stream.isatty() for stream in (sys.stdin, sys.stdout, sys.stderr)):
        raise ConfigError("monitor: no terminal here; use --web PORT for a web page, or `icrl-dist tap` for JSON lines")
    what = arguments.what
    if what is not None and not arguments.connect and _holds_runs(what):
        return _monitor_runs(what, arguments, console)
    with contextlib.ExitStack() as stack:
        if what is not None and not arguments.connect and not _is_active(what, console):
            feed: LiveFeed | ReplayFeed = stack.enter_context(ReplayFeed(what, arguments.speed))
        else:
            endpoint, certificates, folder = _learner_of(what, arguments.connect, arguments.certificates)
            settings = security.client(certificates, "monitor")
            link = stack.enter_context(ZenohLink.connect(endpoint, arguments.timeout, settings))
            feed = stack.enter_context(LiveFeed(link, _run_name(folder), folder))
        if arguments.web is not None:
            from icrl_dist.monitor.page import serve

            return serve(feed, arguments.host, arguments.web, console)
        from icrl_dist.monitor.screen import watch

        return watch(feed) or OK


def _holds_runs(folder: Path) -> bool:
    """Whether the path is a folder of runs and not a run; a folder that does not exist yet may become one."""
    return not folder.exists() or (folder.is_dir() and not any((folder / name).exists() for name in ("run.toml", "dataset")))


def _monitor_runs(what: Path, arguments: MonitorArguments, console: Console) -> int:
    """Show the runs of a folder until the user ends the view.  Returns the exit code."""
    from icrl_dist.monitor import folder

    open_run = functools.partial(folder.open_feed, speed=arguments.speed, certificates=arguments.certificates or "")
    if arguments.web is not None:
        return folder.serve(what, arguments.host, arguments.web, open_run, console)
    return folder.watch(what, open_run, console)


@dataclass(frozen=True)
class TapArguments:
    """Print one JSON line per trajectory, live, from the monitor plane of an active run.

    For example, ``icrl-dist tap --task 3 --adversary dirichlet --every 10`` prints every tenth
    trajectory that passes both filters.

    A tap cannot slow the run down: messages that it does not read in time are dropped.
    """

    what: Annotated[tyro.conf.Positional[Path | None], tyro.conf.arg(metavar="[RUN_DIR]")] = None
    """Folder of an active run.  Default, without --connect: the newest under runs/."""
    connect: str | None = None
    """Endpoint of a learner, such as tcp/127.0.0.1:7447."""
    certificates: str | None = None
    """Folder with ca.pem, monitor.pem and monitor.key, for a learner at tls/.  Default: the run's
    folder of certificates."""
    task: tuple[int, ...] = ()
    """Print only these tasks, by their numbers."""
    adversary: tuple[str, ...] = ()
    """Print only these adversaries: numbers of variations, or kinds such as ``dirichlet`` or ``null``."""
    every: int = 1
    """Print only every n-th of the trajectories that pass the filters."""
    format: Literal["json", "msgpack"] = "json"
    """``json``: one line per trajectory.  ``msgpack``: the same maps as a msgpack stream."""
    count: int = 0
    """End after this many trajectories; 0 continues until Ctrl-C."""
    timeout: float = 30.0
    """Seconds to wait for a connection to the learner."""


def tap(arguments: TapArguments, console: Console) -> int:
    """Print trajectories until Ctrl-C or ``--count``.  Returns the exit code."""
    from icrl_dist.monitor.tap import TapWriter
    from icrl_dist.stream import security
    from icrl_dist.stream.zenoh_link import ZenohLink

    endpoint, certificates, folder = _learner_of(arguments.what, arguments.connect, arguments.certificates)
    ended = threading.Event()
    tapped = TapWriter(arguments.task, arguments.adversary, arguments.every, arguments.format, arguments.count, ended.set)
    client = security.client(certificates, "monitor")
    with on_signals(ended.set), ZenohLink.connect(endpoint, arguments.timeout, client) as link:
        link.subscribe(f"icrl/{_run_name(folder) or '*'}/mon/trajectories/**", tapped)
        ended.wait()
    if tapped.error is None:
        return OK
    if isinstance(tapped.error, BrokenPipeError):
        raise tapped.error  # ``main`` ends every command alike whose reader has gone
    os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())  # Python must not try to flush the rest at exit
    print(f"icrl-dist: tap: standard output cannot be written: {tapped.error.strerror}", file=sys.stderr)
    return FAILED


def _is_active(folder: Path, console: Console) -> bool:
    """Whether a learner is running on the folder.

    A crashed learner leaves its endpoint file behind; in that case a line explains why the run is replayed.
    """
    from icrl_dist.storage.files import held

    if not (folder / "endpoint").is_file():
        return False
    if held(folder):
        return True
    text = "no learner is running here, so the run is replayed; for a learner on another machine use --connect ENDPOINT"
    console.print(f"{folder}: {text}", highlight=False, markup=False)
    return False


def _learner_of(what: Path | None, connect: str | None, certificates: str | None) -> tuple[str, str, Path | None]:
    """The endpoint of the learner, the folder of certificates for it, and its run folder.

    The run folder is None with ``--connect``, because the endpoint identifies the run.  Raises
    ConfigError if no run is active, or if a TLS endpoint has no certificates.
    """
    from icrl_dist.storage.files import held

    if connect:
        if not certificates and connect.startswith("tls/"):
            raise ConfigError(
                f"--connect {connect}: TLS needs --certificates, a folder with ca.pem, monitor.pem and monitor.key"
            )
        return connect, certificates or "", None
    files = [what / "endpoint"] if what else sorted(Path("runs").glob("[!.]*/endpoint"), key=lambda f: f.stat().st_mtime)
    files = [file for file in files if held(file.parent)] or files  # a crashed learner leaves its endpoint file behind
    if not files or not files[-1].is_file():
        raise ConfigError(
            f"no run is active in {what or 'runs/'}: start one with `icrl-dist train`, or name it with --connect tcp/HOST:PORT"
        )
    folder = files[-1].parent
    stream = load_folder(folder).stream
    endpoint = stream.connect or files[-1].read_text().strip()
    return endpoint, certificates or stream.certificates, folder


def _run_name(folder: Path | None) -> str:
    """The name of the run in a folder; empty without a folder.

    Also empty if the folder is a symbolic link with another name: its learner may use either name.
    """
    if folder is None:
        return ""
    name = folder.absolute().name
    return name if folder.resolve().name == name else ""
