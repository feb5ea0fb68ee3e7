"""A run folder as the messages that its monitor plane carried, as far as the disk tells.

The dataset knows every trajectory and their order, not when each came: ``metrics.jsonl`` says
once a second how many were stored, and between two such rows they are spread evenly.
Heartbeats are not stored: workers are seen by what they finished.
"""

from __future__ import annotations

import heapq
import itertools
import json
from bisect import bisect_left
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from icrl_dist.config.run import ConfigError, load
from icrl_dist.methods.recipes import METHODS, about
from icrl_dist.storage.dataset import Dataset
from icrl_dist.storage.index import Row
from icrl_dist.stream import monitor_messages, wire
from icrl_dist.stream.link import StreamKeys

_BEAT_S = 1.0
_EPISODES_S = 1.0
"""An episode to be drawn a worker, this often."""

Message = tuple[float, str, bytes]
"""When it was said (Unix seconds), its key, and what was said."""


class Recording:
    """A run folder to be played."""

    def __init__(self, folder: Path) -> None:
        """Raises ConfigError if the folder has no run, or nothing of it to play."""
        if not (folder / "run.toml").is_file():
            raise ConfigError(f"{folder}: not a run folder (no run.toml); name one, or a run that is on with --connect")
        self._run, self._folder, self._keys = load(str(folder / "run.toml")), folder, StreamKeys(folder.absolute().name)
        self._rows = sorted(_read(folder / "metrics.jsonl"), key=lambda row: float(row["time"]))
        self._store = Dataset(folder / "dataset", readonly=True)
        self._ordered = sorted(self._store.index, key=lambda row: (row.segment, row.offset))
        if not self._rows or not self._ordered:
            self._store.close()
            raise ConfigError(f"{folder}: nothing to play: no trajectory was stored, or metrics.jsonl is empty")
        self._when = self._times()
        self.begin, self.end = min(self._rows[0]["time"], self._when[0]), max(self._rows[-1]["time"], self._when[-1])

    def close(self) -> None:
        """Let go of the dataset."""
        self._store.close()

    def _times(self) -> list[float]:
        """When each trajectory was stored, in that order."""
        marks: list[tuple[int, float]] = []
        for row in self._rows:
            if row["stage"] == "ingest":
                marks.append((row["trajectories"], row["time"]))
            elif row["stage"] == "version" and marks:  # none is stored during a fit: the next come after it
                marks.append((marks[-1][0], row["time"]))
        marks = [(0, self._rows[0]["time"] - 1.0), *sorted(marks)] if marks else [(0, self._rows[0]["time"])]
        counts = [count for count, _ in marks]
        times = []
        for number in range(1, len(self._ordered) + 1):
            after = min(bisect_left(counts, number), len(marks) - 1)
            (low, then), (high, now) = marks[max(0, after - 1)], marks[after]
            share = min(1.0, (number - low) / max(1, high - low))
            times.append(then + (now - then) * share)
        return list(itertools.accumulate(times, max))

    def messages(self) -> Iterator[Message]:
        """Everything that was said, in order of time."""
        return heapq.merge(self._from_metrics(), self._from_dataset(), key=lambda message: message[0])

    def _from_metrics(self) -> Iterator[Message]:
        method = METHODS[self._run.method]
        phases = method.phases(self._run)
        asked = {phase.next_version: method.ask(self._run, phase) for phase in phases}
        expected = {version: sum(job.trials * len(job.variations) for job in jobs) for version, jobs in asked.items()}
        told_of = about(self._run, phases, [job for jobs in asked.values() for job in jobs])
        yield self._said(self.begin, "run", "run", **told_of, began=self.begin)
        version, stored = -1, 0
        of = {phase.next_version: phase for phase in phases}
        for row in self._rows:
            now, stage, step = row["time"], row["stage"], row["step"]
            if stage in ("event", "alert"):
                told = {name: row[name] for name in ("worker", "alive", "identity", "active", "version") if name in row}
                what = {"what": "alert", "alert": row["what"]} if stage == "alert" else {"what": row["what"]}
                yield self._said(now, "event", "event", text=row["text"], **told, **what)
            elif stage == "version":
                version = step
            elif stage == "ingest" and step in of:
                stored = row["trajectories"]
                drops = {"all": int(row["drops"])} if row["drops"] else {}
                where = {
                    "stage": "collect",
                    "step": row["arrived"],
                    "steps": expected[step],
                    "workers": row["workers"],
                }
                yield self._progress(now, of[step], version, stored, **where, lag=row["lag"], drops=drops)
            elif stage.startswith("fit/") and int(stage[4:]) in of:
                phase = of[int(stage[4:])]
                where = {"stage": "fit", "step": step, "steps": phase.steps, "loss": row["loss"], "workers": 0}
                yield self._progress(now, phase, version, stored, **where, lag=0, drops={})

    def _progress(self, now: float, phase: Any, version: int, stored: int, **values: Any) -> Message:
        common = {"phase": phase.stage, "round": phase.round, "version": version, "trajectories": stored, "doing": []}
        return self._said(now, "learner", "learner", **common, **values)

    def _from_dataset(self) -> Iterator[Message]:
        done: Counter[str] = Counter()
        steps: Counter[str] = Counter()
        beaten: dict[str, float] = {}
        drawn: dict[str, float] = {}
        for now, row in zip(self._when, self._ordered, strict=True):
            trajectory, worker = self._store.read(row.identity), row.worker
            yield now, self._keys.monitor(f"trajectories/{_part(worker)}"), monitor_messages.trajectories([trajectory], now)
            done[worker] += 1
            steps[worker] += len(trajectory.actions)
            if now - drawn.get(worker, 0.0) >= _EPISODES_S:
                drawn[worker] = now
                yield now, self._keys.monitor(f"episode/{_part(worker)}"), monitor_messages.episode(trajectory, now)
            if now - beaten.get(worker, 0.0) >= _BEAT_S:
                beaten[worker] = now
                yield self._beat(now, row, done[worker], steps[worker])

    def _beat(self, now: float, row: Row, episodes: int, steps: int) -> Message:
        job = "/".join(map(str, row.identity[:3]))
        counts = {"episodes": episodes, "trajectories": episodes, "steps": steps, "resent": 0, "pid": 0}
        said = {
            "worker": row.worker,
            "job": job,
            "doing": "",
            "policy_version": row.policy_version,
            "memory_mb": 0.0,
            "peak_mb": 0.0,
        }
        return self._said(now, f"worker/{_part(row.worker)}", "worker", **said, **counts)

    def _said(self, now: float, topic: str, kind: str, **fields: Any) -> Message:
        return now, self._keys.monitor(topic), wire.encode_message(kind, time=now, **fields)


def _part(worker: str) -> str:
    """A name from a dataset, as part of a key."""
    return "".join(c if c.isprintable() and c not in "/*$?#" else "_" for c in worker) or "_"


def _read(path: Path) -> Iterator[dict[str, Any]]:
    """The rows of a metrics file, up to a torn last line; none if there is no file."""
    if not path.is_file():
        return
    for line in path.read_text(encoding="utf-8", errors="replace").splitlines():
        try:
            row = json.loads(line)
        except ValueError:
            continue
        if isinstance(row, dict) and {"time", "stage", "step"} <= row.keys():
            yield row
