"""The cost of monitoring: CPU per trajectory of workers and learner with and without a viewer, and the viewer's CPU.

The runs are real, with Ray workers and Zenoh.  Intervals with and without a viewer alternate in one run,
so that other load on the machine affects both.
"""

from __future__ import annotations

import contextlib
import json
import os
import pty
import signal
import statistics
import subprocess
import tempfile
import threading
import time
import urllib.request
from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, Literal

import psutil

from icrl_dist.bench.training import need_alive, training
from icrl_dist.stream import wire
from icrl_dist.stream.link import StreamKeys
from icrl_dist.stream.zenoh_link import ZenohLink
from icrl_dist.telemetry import processes
from icrl_dist.telemetry.processes import is_learner, is_worker

BOUND = 0.98
"""Smallest accepted ratio of CPU per trajectory without a viewer to that with one."""
STREAMS, PER_S = 1000, 20.0
PAGE_CORES, TERMINAL_CORES = 0.5, 1.0
_FULL = ("--context.max", "200", "--stream.job-tasks", "2")
"""Contexts are full after six episodes, so later episodes have equal costs.  16 episodes of a job end together instead
of 80, so that an interval of a few seconds counts its trajectories to 1%."""
_ROUND = (*_FULL, "--pretrain.contexts", "390", "--pretrain.steps", "20", "--icaa.trials", "1500", "--icaa.context-trials", "5")
_CONTEXTS = ("--method", "dpt", "--pretrain.contexts", "780000")
_PIPES: Mapping[str, Any] = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "text": True, "bufsize": 1}
_VIEWER = processes.python("-m", "icrl_dist.bench.viewer")

How = Literal["live", "stopped"]


def run(folder: Path = Path("runs"), pairs: int = 8, seconds: float = 5.0) -> dict[str, Any]:
    """Measure an ICAA round, the collection of random contexts, and both views with ``STREAMS`` variations.

    ``ratio_live`` and ``ratio_stopped``: CPU seconds per trajectory without a viewer, divided by those with
    a running viewer or with one stopped by SIGSTOP, over ``pairs`` pairs of intervals of ``seconds`` in an
    ICAA round.  ``contexts_...``: the same for random contexts, where a trajectory costs least.
    ``page_cores``, ``terminal_cores``: CPU seconds per second of the two views, with ``STREAMS`` variations
    that each end ``PER_S`` episodes per second.  ``ok``: all within the bounds.
    """
    folder.mkdir(parents=True, exist_ok=True)
    result: dict[str, Any] = {"pairs": pairs, "window_s": seconds, "load": round(os.getloadavg()[0], 1)}
    with tempfile.TemporaryDirectory(dir=folder, prefix="monitor-") as scratch:
        for name, settings in (("", _ROUND), ("contexts_", _CONTEXTS)):
            result |= _measure_run(Path(scratch) / (name.strip("_") or "round"), settings, pairs, seconds, name)
    result |= _measure_views(10.0)
    result["ratio"] = min(result["ratio_live"], result["ratio_stopped"])
    cheap = result["page_cores"] < PAGE_CORES and result["terminal_cores"] < TERMINAL_CORES
    return {**result, "ok": result["ratio"] >= BOUND and cheap}


def describe(result: dict[str, Any]) -> str:
    """The result as a few lines."""
    r = result
    return (
        f"CPU per trajectory, without a viewer / with one: {r['ratio_live']:.3f} live, {r['ratio_stopped']:.3f} stopped "
        f"(ICAA, {r['ms']:.2f} ms; at least {BOUND});\n"
        f"  {r['contexts_ratio_live']:.3f} and {r['contexts_ratio_stopped']:.3f} where a trajectory costs least "
        f"(random contexts, {r['contexts_ms']:.2f} ms)\n"
        f"{STREAMS} streams at {PER_S:g}/s: page {r['page_cores']:.2f} cores (below {PAGE_CORES}), of "
        f"{r['sent_per_s']:,.0f} episodes/s it received {r['page_heard_per_s']:,.0f}; terminal {r['terminal_cores']:.2f} cores "
        f"(below {TERMINAL_CORES:g})\n"
        f"{'within the bounds' if r['ok'] else 'OUT OF BOUNDS'}; load average before: {r['load']}"
    )


def _measure_run(out: Path, settings: Sequence[str], pairs: int, seconds: float, name: str) -> dict[str, Any]:
    with training("demo", out, *settings) as process:
        while not (out / "endpoint").is_file():
            need_alive(process)
            time.sleep(0.1)
        threading.Thread(target=lambda: [None for _ in process.stdout or ()], daemon=True).start()
        endpoint = (out / "endpoint").read_text().strip()
        with ZenohLink.connect(endpoint, 60.0) as link, _ViewerProcess(endpoint) as viewer:
            meter = _CpuMeter(process, link, out.name, "pretrain" if name else "adapt")
            meter.wait()
            spent: dict[tuple[How, bool], list[tuple[float, int]]] = defaultdict(list)
            for pair in range(pairs):
                how: How
                for how in ("live", "stopped"):
                    without_first = pair % 2 == 0
                    for watched in (not without_first, without_first):
                        with viewer.connected(how == "stopped") if watched else contextlib.nullcontext():
                            spent[how, watched].append(meter.spent(seconds))
            if viewer.received == 0:
                raise RuntimeError("the viewer received no message, so nothing was compared; run the benchmark again")
    found: dict[str, Any] = {}
    for how in ("live", "stopped"):
        found[f"{name}ratio_{how}"] = round(_cost(spent[how, False]) / _cost(spent[how, True]), 4)
        both = zip(spent[how, False], spent[how, True], strict=True)
        pairwise = [_cost([without]) / max(1e-9, _cost([with_viewer])) for without, with_viewer in both]
        found[f"{name}spread_{how}"] = [round(min(pairwise), 3), round(max(pairwise), 3)]
    return found | {f"{name}ms": round(1000 * _cost([*spent["live", False], *spent["stopped", False]]), 3)}


def _cost(intervals: Iterable[tuple[float, int]]) -> float:
    """CPU seconds per trajectory over all intervals; one interval is imprecise, because many episodes end together."""
    cpu, trajectories = map(sum, zip(*intervals, strict=True))
    return cpu / max(1, trajectories)


class _CpuMeter:
    """CPU seconds of a run's workers and learner, and its trajectories, at the learner's reports."""

    def __init__(self, process: subprocess.Popen[str], link: ZenohLink, name: str, phase: str) -> None:
        self._process, self._phase = process, phase
        self._changed = threading.Condition()
        self._reports = 0
        self._latest = (0.0, 0)
        self._processes: list[psutil.Process] = []
        link.subscribe(StreamKeys(name).monitor("learner"), self._on_report)

    def _on_report(self, key: str, payload: bytes) -> None:
        _, fields = wire.decode_message(payload)
        if fields["stage"] == "collect" and fields["phase"] == self._phase and fields["step"] > 0:
            with self._changed:
                self._reports += 1
                self._latest = self._cpu(), fields["trajectories"]
                self._changed.notify_all()

    def _cpu(self) -> float:
        if not self._processes:
            children = psutil.Process(self._process.pid).children(recursive=True)
            self._processes = [process for process in children if is_learner(process) or is_worker(process)]
        return sum(sum(process.cpu_times()[:2]) for process in self._processes)

    def wait(self) -> tuple[float, int]:
        """CPU seconds and stored trajectories so far, at the next report."""
        with self._changed:
            reports = self._reports
            while not self._changed.wait_for(lambda: self._reports > reports, 1.0):
                need_alive(self._process)
            return self._latest

    def spent(self, seconds: float) -> tuple[float, int]:
        """CPU seconds and trajectories over an interval of about this many seconds."""
        self.wait()  # skip one report: a viewer has just connected or disconnected
        cpu, stored = self.wait()
        time.sleep(seconds)
        later, more = self.wait()
        return later - cpu, more - stored


class _ViewerProcess:
    """A viewer in a separate process, which can be connected and disconnected."""

    def __init__(self, endpoint: str) -> None:
        self._process = subprocess.Popen([*_VIEWER, "view", endpoint], env=processes.environment(), **_PIPES)
        self.received = 0

    def __enter__(self) -> _ViewerProcess:
        return self

    def __exit__(self, *_: object) -> None:
        self._process.kill()
        self._process.wait()

    def connected(self, stopped: bool) -> _Connected:
        return _Connected(self, stopped)

    def write(self, line: str) -> None:
        assert self._process.stdin is not None
        self._process.stdin.write(line + "\n")
        self._process.stdin.flush()

    def read(self) -> str:
        assert self._process.stdout is not None
        return self._process.stdout.readline().strip()

    def signal(self, number: int) -> None:
        self._process.send_signal(number)


class _Connected:
    """Connects the viewer on entry, stops it by SIGSTOP if ``stopped``, and disconnects it on exit."""

    def __init__(self, viewer: _ViewerProcess, stopped: bool) -> None:
        self._viewer, self._stopped = viewer, stopped

    def __enter__(self) -> None:
        self._viewer.write("on")
        if self._viewer.read() != "on":
            raise RuntimeError("the viewer did not connect")
        if self._stopped:
            self._viewer.signal(signal.SIGSTOP)

    def __exit__(self, *_: object) -> None:
        self._viewer.signal(signal.SIGCONT)
        self._viewer.write("off")
        self._viewer.received += int(self._viewer.read() or 0)


def _measure_views(seconds: float) -> dict[str, Any]:
    """CPU of the page and then of the terminal view, with ``STREAMS`` simulated variations."""
    crowd = subprocess.Popen([*_VIEWER, "crowd", str(STREAMS), str(PER_S)], env=processes.environment(), **_PIPES)
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
    return processes.python("-u", "-m", "icrl_dist.cli", "monitor", "--connect", endpoint, *more)


def _page(endpoint: str, seconds: float, sent: list[int]) -> dict[str, Any]:
    process = subprocess.Popen(_monitor(endpoint, "--web", "0"), stdout=subprocess.PIPE, text=True, env=processes.environment())
    try:
        assert process.stdout is not None
        url = next(word for line in process.stdout for word in line.split() if word.startswith("http://"))
        with urllib.request.urlopen(url.rstrip("/") + "/events", timeout=30) as events:
            threading.Thread(target=_drain, args=(events,), daemon=True).start()
            time.sleep(3.0)
            first, cores = sent[0], _cores(process.pid, seconds)
            received, published = _received_per_s(url, int(seconds)), sent[0] - first
        return {
            "page_cores": round(cores, 3),
            "page_heard_per_s": round(received, 1),
            "sent_per_s": round(published / seconds, 1),
        }
    finally:
        process.send_signal(signal.SIGINT)
        process.wait(20)


def _drain(events: Iterable[bytes]) -> None:
    with contextlib.suppress(OSError, ValueError, AttributeError):  # http.client raises these when it is closed during a read
        for _ in events:
            pass


def _received_per_s(url: str, points: int) -> float:
    """Episodes per second received by the page, averaged over its last ``points`` (one per second)."""
    with urllib.request.urlopen(url.rstrip("/") + "/events", timeout=30) as events:
        for line in events:
            if line.startswith(b"data:"):
                return statistics.mean(json.loads(line[5:])["series"]["episodes_per_s"][-points:])
    raise RuntimeError("the page sent no data; run the benchmark again")


def _terminal(endpoint: str, seconds: float) -> float:
    master, slave = pty.openpty()
    process = subprocess.Popen(
        _monitor(endpoint), stdin=slave, stdout=slave, stderr=slave, env={**processes.environment(), "TERM": "xterm-256color"}
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
    """CPU seconds per second of a process."""
    process = psutil.Process(pid)
    before, began = sum(process.cpu_times()[:2]), time.monotonic()
    time.sleep(seconds)
    return (sum(process.cpu_times()[:2]) - before) / (time.monotonic() - began)
