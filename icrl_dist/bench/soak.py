"""The memory growth of every process in a long run.

The run is real: many short ICAA rounds with Ray workers, Zenoh and the store, a fit, a checkpoint and a
broadcast every few seconds, and a small cache of the dataset.
"""

from __future__ import annotations

import contextlib
import json
import re
import subprocess
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import psutil

from icrl_dist.bench.training import need_alive, training
from icrl_dist.config.run import ConfigError
from icrl_dist.telemetry import metric_rows
from icrl_dist.telemetry.processes import is_learner, is_worker

_SETTINGS = ("--icaa.rounds", "100000", "--icaa.steps", "10", "--learner.cache-mb", "4", "--icaa.trials", "20")
_PERIOD_S = 1.0
WARM_UP = 0.4
"""The share of the time that is not measured: imports, first batches and filling caches."""

Report = Callable[[float, str], None]


def run(seconds: float = 600.0, folder: Path = Path("runs"), report: Report = lambda elapsed, text: None) -> dict[str, Any]:
    """Run for ``seconds`` and measure; writes a temporary run folder and ``soak.png`` to ``folder``.

    ``worst_mb_per_min`` is the largest slope of private memory (RssAnon) after the warm-up, where a slope
    is the median over all pairs of samples.  Raises ConfigError for a time too short for a slope,
    RuntimeError if the run ended early.
    """
    if seconds < 30:
        raise ConfigError(f"bench soak: seconds = {seconds:g}: must be at least 30 to measure a slope")
    folder.mkdir(parents=True, exist_ok=True)
    samples: dict[str, list[tuple[float, float]]] = {}
    with (
        tempfile.TemporaryDirectory(dir=folder, prefix="soak-") as scratch,
        training("smoke", Path(scratch) / "soak", *_SETTINGS) as process,
    ):
        threading.Thread(target=_drain, args=(process,), daemon=True).start()
        began = _wait_for_weights(process, Path(scratch) / "soak")
        while (elapsed := time.monotonic() - began) < seconds:
            need_alive(process)
            for name, mb in _memory(process.pid):
                samples.setdefault(name, []).append((elapsed, mb))
            report(elapsed, _progress(Path(scratch) / "soak"))
            time.sleep(_PERIOD_S)
        done = json.loads(_progress(Path(scratch) / "soak"))
    whole = {name: points for name, points in samples.items() if points[-1][0] - points[0][0] > 0.95 * seconds}
    rows = [
        {"process": name, "mb_per_min": round(_slope(points, seconds), 3), "mb": round(points[-1][1], 1)}
        for name, points in sorted(whole.items())
    ]
    return {
        "worst_mb_per_min": max(float(str(row["mb_per_min"])) for row in rows),
        "seconds": seconds,
        "warm_up_s": WARM_UP * seconds,
        "processes": rows,
        "short_lived": sorted(samples.keys() - whole.keys()),
        **done,
        "figure": str(_plot(whole, seconds, folder / "soak.png")),
    }


def describe(result: dict[str, Any]) -> str:
    """One line per process, the largest slope first."""
    rows = sorted(result["processes"], key=lambda row: -row["mb_per_min"])
    lines = [f"{'process':<28}{'MB/min':>8}{'MB':>8}"]
    lines += [f"{row['process']:<28}{row['mb_per_min']:>8.2f}{row['mb']:>8.1f}" for row in rows]
    lines += [f"{result['trajectories']} trajectories, weights version {result['version']}, {result['seconds']:.0f} s"]
    return "\n".join([*lines, f"worst {result['worst_mb_per_min']:.2f} MB/min; figure {result['figure']}"])


def _drain(process: subprocess.Popen[str]) -> None:
    assert process.stdout is not None
    for _ in process.stdout:
        pass


def _wait_for_weights(process: subprocess.Popen[str], folder: Path, timeout_s: float = 120.0) -> float:
    deadline = time.monotonic() + timeout_s
    while json.loads(_progress(folder))["version"] < 1:
        need_alive(process)
        if time.monotonic() > deadline:
            raise RuntimeError(f"no weights after {timeout_s:.0f} s; check the machine with `icrl-dist doctor`")
        time.sleep(0.2)
    return time.monotonic()


def _progress(folder: Path) -> str:
    """The run's progress from its metrics: trajectories and the latest policy version, as JSON."""
    trajectories, version = 0, -1
    for row in metric_rows.read(folder):
        if row["stage"] == "collect":
            trajectories += row["trajectories"]
        elif row["stage"] == "version":
            version = row["step"]
    return json.dumps({"trajectories": trajectories, "version": version})


def _memory(pid: int) -> Iterator[tuple[str, float]]:
    """Name and private memory in MB of a process and of its descendants."""
    with contextlib.suppress(psutil.Error):
        root = psutil.Process(pid)
        for process in (root, *root.children(recursive=True)):
            with contextlib.suppress(psutil.Error, OSError):
                status = Path(f"/proc/{process.pid}/status").read_text()
                found = re.search(r"RssAnon:\s+(\d+) kB", status)
                if found:
                    yield f"{_name(process, root)} {process.pid}", int(found[1]) / 1024


def _name(process: psutil.Process, root: psutil.Process) -> str:
    if process == root:
        return "icrl-dist train"
    if is_learner(process):
        return "learner"
    return "worker" if is_worker(process, spare=True) else process.name()[:20]


def _slope(points: list[tuple[float, float]], seconds: float) -> float:
    """The Theil-Sen slope in MB per minute: the median slope over all pairs of samples after the warm-up."""
    from scipy.stats import theilslopes

    after = np.array([point for point in points if point[0] > WARM_UP * seconds])
    return float(theilslopes(after[:, 1], after[:, 0] / 60)[0])


def _plot(samples: dict[str, list[tuple[float, float]]], seconds: float, path: Path) -> Path:
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    figure, axis = pyplot.subplots(figsize=(8, 4.2))
    for name, points in sorted(samples.items(), key=lambda item: -item[1][-1][1])[:8]:
        minutes, mb = np.array(points).T
        axis.plot(minutes / 60, mb, label=f"{name.rsplit(' ', 1)[0]}: {_slope(points, seconds):+.2f} MB/min", linewidth=1.4)
    axis.axvspan(0, WARM_UP * seconds / 60, color="black", alpha=0.06, linewidth=0)
    axis.set(xlabel="minutes (grey: warm-up, not measured)", ylabel="private memory, MB", ylim=(0, None))
    axis.legend(fontsize=8, loc="center left", bbox_to_anchor=(1.0, 0.5))
    axis.grid(alpha=0.25)
    figure.tight_layout()
    figure.savefig(path, dpi=120)
    pyplot.close(figure)
    return path
