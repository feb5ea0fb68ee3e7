"""What being watched costs: CPU a trajectory in workers and learner with and without a viewer, and what a viewer takes.

The runs are real, through Ray workers and Zenoh.  Pairs of windows, one without and one with a
viewer, follow each other in one run, so that what else the machine does meets both.
"""

from __future__ import annotations

import contextlib
import json
import os
import pty
import signal
import statistics
import subprocess
import sys
import tempfile
import threading
import time
import urllib.request
from collections import defaultdict
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any, Literal

import psutil

from icrl_dist.bench.training import need_alive, training
from icrl_dist.stream import wire
from icrl_dist.stream.link import StreamKeys
from icrl_dist.stream.zenoh_link import ZenohLink
from icrl_dist.telemetry.processes import is_learner, is_worker

BOUND = 0.98
"""Being watched may cost a trajectory's CPU time this share."""
STREAMS, PER_S = 1000, 20.0
PAGE_CORES, TERMINAL_CORES = 0.5, 1.0
_FULL = ("--context.max", "200", "--stream.job-tasks", "2")
"""Contexts are full after six episodes: from then on each costs the same.  A job ends 16 episodes at a time, not
80: so a window of some seconds holds hundreds of such times, and counts trajectories to a hundredth."""
_ROUND = (*_FULL, "--pretrain.contexts", "390", "--pretrain.steps", "20", "--icaa.trials", "1500", "--icaa.context-trials", "5")
_CONTEXTS = ("--method", "dpt", "--pretrain.contexts", "780000")
_VIEWER = (sys.executable, "-m", "icrl_dist.bench.viewer")

How = Literal["live", "stopped"]


def run(folder: Path = Path("runs"), pairs: int = 8, seconds: float = 5.0) -> dict[str, Any]:
    """Watch an ICAA round and the making of random contexts, then the crowd.

    ``ratio_live`` and ``ratio_stopped``: CPU seconds a trajectory without a viewer over those with
    one that looks on, or that was stopped by SIGSTOP; over ``pairs`` pairs of windows of ``seconds``, in
    an ICAA round; ``contexts_...``: the same where a trajectory costs least.
    ``page_cores``, ``terminal_cores``: CPU seconds a second of the two views, ``STREAMS`` variations
    ending ``PER_S`` episodes a second each.  ``ok``: within the bounds.
    """
    folder.mkdir(parents=True, exist_ok=True)
    result: dict[str, Any] = {"pairs": pairs, "window_s": seconds, "load": round(os.getloadavg()[0], 1)}
    with tempfile.TemporaryDirectory(dir=folder, prefix="monitor-") as scratch:
        for name, settings in (("", _ROUND), ("contexts_", _CONTEXTS)):
            result |= _watched(Path(scratch) / (name.strip("_") or "round"), settings, pairs, seconds, name)
    result |= _crowd(10.0)
    result["ratio"] = min(result["ratio_live"], result["ratio_stopped"])
    cheap = result["page_cores"] < PAGE_CORES and result["terminal_cores"] < TERMINAL_CORES
    return {**result, "ok": result["ratio"] >= BOUND and cheap}


def describe(result: dict[str, Any]) -> str:
    """The result as a few lines."""
    r = result
    return (
        f"CPU a trajectory without a viewer over with one: {r['ratio_live']:.3f} live, {r['ratio_stopped']:.3f} stopped "
        f"(ICAA, {r['ms']:.2f} ms; at least {BOUND});\n"
        f"  {r['contexts_ratio_live']:.3f} and {r['contexts_ratio_stopped']:.3f} where it is cheapest "
        f"(random contexts, {r['contexts_ms']:.2f} ms)\n"
        f"{STREAMS} streams at {PER_S:g}/s: page {r['page_cores']:.2f} cores (below {PAGE_CORES}), of "
        f"{r['sent_per_s']:,.0f} episodes/s it heard {r['page_heard_per_s']:,.0f}; terminal {r['terminal_cores']:.2f} cores "
        f"(below {TERMINAL_CORES:g})\n"
        f"{'within the bounds' if r['ok'] else 'OUT OF BOUNDS'}; load average before: {r['load']}"
    )


def _watched(out: Path, settings: Sequence[str], pairs: int, seconds: float, name: str) -> dict[str, Any]:
    with training("demo", out, *settings) as process:
        while not (out / "endpoint").is_file():
            need_alive(process)
            time.sleep(0.1)
        threading.Thread(target=lambda: [None for _ in process.stdout or ()], daemon=True).start()
        endpoint = (out / "endpoint").read_text().strip()
        with ZenohLink.connect(endpoint, 60.0) as link, _Viewer(endpoint) as viewer:
            meter = _Meter(process, link, out.name, "pretrain" if name else "adapt")
            meter.wait()
            spent: dict[tuple[How, bool], list[tuple[float, int]]] = defaultdict(list)
            for pair in range(pairs):
                how: How
                for how in ("live", "stopped"):
                    alone_first = pair % 2 == 0
                    for watched in (not alone_first, alone_first):
                        with viewer.watching(how == "stopped") if watched else contextlib.nullcontext():
                            spent[how, watched].append(meter.spent(seconds))
            if viewer.heard == 0:
                raise RuntimeError("the viewer heard nothing: nothing was compared")
    told: dict[str, Any] = {}
    for how in ("live", "stopped"):
        told[f"{name}ratio_{how}"] = round(_cost(spent[how, False]) / _cost(spent[how, True]), 4)
        both = zip(spent[how, False], spent[how, True], strict=True)
        pairwise = [_cost([alone]) / max(1e-9, _cost([beside])) for alone, beside in both]
        told[f"{name}spread_{how}"] = [round(min(pairwise), 3), round(max(pairwise), 3)]
    return told | {f"{name}ms": round(1000 * _cost([*spent["live", False], *spent["stopped", False]]), 3)}


def _cost(windows: Iterable[tuple[float, int]]) -> float:
    """CPU seconds a trajectory over all of these windows: jobs end many episodes at once, so one window is coarse."""
    cpu, made = map(sum, zip(*windows, strict=True))
    return cpu / max(1, made)


class _Meter:
    """CPU seconds a trajectory, in a run's workers and learner, from one of the learner's reports to another."""

    def __init__(self, process: subprocess.Popen[str], link: ZenohLink, name: str, phase: str) -> None:
        self._process, self._phase = process, phase
        self._changed = threading.Condition()
        self._reports = 0
        self._now = (0.0, 0)
        self._family: list[psutil.Process] = []
        link.subscribe(StreamKeys(name).monitor("learner"), self._hear)

    def _hear(self, key: str, payload: bytes) -> None:
        _, fields = wire.decode_message(payload)
        if fields["stage"] == "collect" and fields["phase"] == self._phase and fields["step"] > 0:
            with self._changed:
                self._reports += 1
                self._now = self._cpu(), fields["trajectories"]
                self._changed.notify_all()

    def _cpu(self) -> float:
        if not self._family:
            everyone = psutil.Process(self._process.pid).children(recursive=True)
            self._family = [one for one in everyone if is_learner(one) or is_worker(one)]
        return sum(sum(one.cpu_times()[:2]) for one in self._family)

    def wait(self) -> tuple[float, int]:
        """CPU seconds so far and trajectories stored, at the next report."""
        with self._changed:
            reports = self._reports
            while not self._changed.wait_for(lambda: self._reports > reports, 1.0):
                need_alive(self._process)
            return self._now

    def spent(self, seconds: float) -> tuple[float, int]:
        """CPU seconds and trajectories over the next so many seconds."""
        self.wait()  # what has just changed settles
        cpu, stored = self.wait()
        time.sleep(seconds)
        later, more = self.wait()
        return later - cpu, more - stored


class _Viewer:
    """A viewer in a process of its own, which looks on by turns."""

    def __init__(self, endpoint: str) -> None:
        self._process = subprocess.Popen(
            [*_VIEWER, "view", endpoint], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, bufsize=1
        )
        self.heard = 0

    def __enter__(self) -> _Viewer:
        return self

    def __exit__(self, *_: object) -> None:
        self._process.kill()
        self._process.wait()

    def watching(self, stopped: bool) -> _Watching:
        return _Watching(self, stopped)

    def say(self, line: str) -> None:
        assert self._process.stdin is not None
        self._process.stdin.write(line + "\n")
        self._process.stdin.flush()

    def answer(self) -> str:
        assert self._process.stdout is not None
        return self._process.stdout.readline().strip()

    def signal(self, number: int) -> None:
        self._process.send_signal(number)


class _Watching:
    def __init__(self, viewer: _Viewer, stopped: bool) -> None:
        self._viewer, self._stopped = viewer, stopped

    def __enter__(self) -> None:
        self._viewer.say("on")
        if self._viewer.answer() != "on":
            raise RuntimeError("the viewer could not connect")
        if self._stopped:
            self._viewer.signal(signal.SIGSTOP)

    def __exit__(self, *_: object) -> None:
        self._viewer.signal(signal.SIGCONT)
        self._viewer.say("off")
        self._viewer.heard += int(self._viewer.answer() or 0)


def _crowd(seconds: float) -> dict[str, Any]:
    """Both views of a crowd of streams, one after the other."""
    crowd = subprocess.Popen(
        [*_VIEWER, "crowd", str(STREAMS), str(PER_S)], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, bufsize=1
    )
    try:
        assert crowd.stdout is not None
        endpoint = crowd.stdout.readline().strip()
        sent = [0]

        def count() -> None:
            assert crowd.stdout is not None
            for line in crowd.stdout:
                sent[0] = int(line)

        threading.Thread(target=count, daemon=True).start()
        page = _page(endpoint, seconds, sent)
        return {**page, "terminal_cores": _terminal(endpoint, seconds)}
    finally:
        crowd.kill()
        crowd.wait()


def _monitor(endpoint: str, *more: str) -> list[str]:
    return [sys.executable, "-u", "-m", "icrl_dist.cli", "monitor", "--connect", endpoint, *more]


def _page(endpoint: str, seconds: float, sent: list[int]) -> dict[str, Any]:
    process = subprocess.Popen(_monitor(endpoint, "--web", "0"), stdout=subprocess.PIPE, text=True)
    try:
        assert process.stdout is not None
        url = next(word for line in process.stdout for word in line.split() if word.startswith("http://"))
        with urllib.request.urlopen(url.rstrip("/") + "/events", timeout=30) as events:
            threading.Thread(target=_drain, args=(events,), daemon=True).start()
            time.sleep(3.0)
            first, cores = sent[0], _cores(process.pid, seconds)
            heard, said = _heard_per_s(url, int(seconds)), sent[0] - first
        return {
            "page_cores": round(cores, 3),
            "page_heard_per_s": round(heard, 1),
            "sent_per_s": round(said / seconds, 1),
        }
    finally:
        process.send_signal(signal.SIGINT)
        process.wait(20)


def _drain(events: Iterable[bytes]) -> None:
    with contextlib.suppress(OSError, ValueError, AttributeError):  # http.client's own, when it is closed meanwhile
        for _ in events:
            pass


def _heard_per_s(url: str, points: int) -> float:
    """Episodes a second that the page knows of, over its last points, one a second."""
    with urllib.request.urlopen(url.rstrip("/") + "/events", timeout=30) as events:
        for line in events:
            if line.startswith(b"data:"):
                return statistics.mean(json.loads(line[5:])["series"]["episodes_per_s"][-points:])
    raise RuntimeError("the page told nothing")


def _terminal(endpoint: str, seconds: float) -> float:
    master, slave = pty.openpty()
    process = subprocess.Popen(
        _monitor(endpoint), stdin=slave, stdout=slave, stderr=slave, env={**os.environ, "TERM": "xterm-256color"}
    )
    os.close(slave)
    ended = threading.Event()

    def drain() -> None:
        while not ended.is_set():
            try:
                os.read(master, 65536)
            except OSError:
                return

    threading.Thread(target=drain, daemon=True).start()
    try:
        time.sleep(5.0)
        return round(_cores(process.pid, seconds), 3)
    finally:
        process.send_signal(signal.SIGINT)
        os.write(master, b"q")
        try:
            process.wait(20)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()
        ended.set()


def _cores(pid: int, seconds: float) -> float:
    one = psutil.Process(pid)
    before, then = sum(one.cpu_times()[:2]), time.monotonic()
    time.sleep(seconds)
    return (sum(one.cpu_times()[:2]) - before) / (time.monotonic() - then)
