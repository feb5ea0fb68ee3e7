"""Reconstructs the monitor messages of a run from its folder.

The dataset contains every trajectory in the order in which they were stored, but not the times.
``metrics.jsonl`` and its older files contain the number of stored trajectories once a second, later at
most once a minute; between two such rows the trajectories are spread evenly.  Times are those of a
replay, without pauses (``pauses``).  Heartbeats are not stored, so they are made from the trajectories
that each worker finished.
"""

from __future__ import annotations

import heapq
import itertools
from bisect import bisect_left
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from icrl_dist.config.run import ConfigError, load_folder
from icrl_dist.methods import registry as methods
from icrl_dist.monitor.pauses import session_starts, without_pauses
from icrl_dist.storage.dataset import Dataset
from icrl_dist.storage.index import Row
from icrl_dist.stream import monitor_messages, wire
from icrl_dist.stream.link import StreamKeys
from icrl_dist.telemetry import metric_rows
from icrl_dist.telemetry.about import about

_HEARTBEAT_S = 1.0
"""Time between two heartbeats of a worker."""
_EPISODE_S = 1.0
"""Time between two drawn episodes of a worker."""

Message = tuple[float, str, bytes]
"""Time (Unix seconds), key and payload."""


class Recording:
    """The monitor messages of a run folder."""

    def __init__(self, folder: Path) -> None:
        """Raises ConfigError if the folder is not a run folder, or contains nothing to play."""
        if not (folder / "run.toml").is_file():
            raise ConfigError(f"{folder}: not a run folder (no run.toml); name a run folder, or a live run with --connect")
        self._run, self._folder, self._keys = load_folder(folder), folder, StreamKeys(folder.absolute().name)
        self._rows = without_pauses(list(metric_rows.read(folder)), session_starts(folder))
        self._store = Dataset(folder / "dataset", readonly=True)
        self._ordered = sorted(self._store.index, key=lambda row: (row.segment, row.offset))
        if not self._rows or not self._ordered:
            self._store.close()
            raise ConfigError(
                f"{folder}: nothing to play: no trajectory was stored, or metrics.jsonl is empty; name another run"
            )
        self._stored_at = self._times()
        self.begin = min(self._rows[0]["time"], self._stored_at[0])
        self.end = max(self._rows[-1]["time"], self._stored_at[-1])

    def close(self) -> None:
        """Close the dataset."""
        self._store.close()

    def _times(self) -> list[float]:
        """Estimated time at which each trajectory was stored, in that order."""
        marks: list[tuple[int, float]] = []
        for row in self._rows:
            if row["stage"] == "ingest":
                marks.append((row["trajectories"], row["time"]))
            elif row["stage"] == "version" and marks:  # no trajectory is stored during a fit
                marks.append((marks[-1][0], row["time"]))
        marks = [(0, self._rows[0]["time"] - 1.0), *sorted(marks)] if marks else [(0, self._rows[0]["time"])]
        counts = [count for count, _ in marks]
        times = []
        for number in range(1, len(self._ordered) + 1):
            after = min(bisect_left(counts, number), len(marks) - 1)
            (low, begin), (high, end) = marks[max(0, after - 1)], marks[after]
            share = min(1.0, (number - low) / max(1, high - low))
            times.append(begin + (end - begin) * share)
        return list(itertools.accumulate(times, max))

    def messages(self) -> Iterator[Message]:
        """All messages, in order of time."""
        return heapq.merge(self._from_metrics(), self._from_dataset(), key=lambda message: message[0])

    def _from_metrics(self) -> Iterator[Message]:
        method = methods.of(self._run)
        phases = method.phases(self._run)
        jobs = {phase.next_version: method.ask(self._run, phase) for phase in phases}
        expected = {version: sum(job.trials * len(job.variations) for job in some) for version, some in jobs.items()}
        info = about(self._run, phases, [job for some in jobs.values() for job in some])
        yield self._message(self.begin, "run", "run", **info, began=self.begin)
        version, stored = -1, 0
        by_version = {phase.next_version: phase for phase in phases}
        for row in self._rows:
            now, stage, step = row["time"], row["stage"], row["step"]
            if stage in ("event", "alert"):
                fields = {name: row[name] for name in ("worker", "alive", "identity", "active", "version") if name in row}
                what = {"what": "alert", "alert": row["what"]} if stage == "alert" else {"what": row["what"]}
                yield self._message(now, "event", "event", text=row["text"], **fields, **what)
            elif stage == "version":
                version = step
            elif stage == "ingest" and step in by_version:
                stored = row["trajectories"]
                drops = {"all": int(row["drops"])} if row["drops"] else {}
                values = {"step": row["arrived"], "steps": expected[step], "workers": row["workers"], "lag": row["lag"]}
                yield self._progress(now, by_version[step], version, stored, **values, stage="collect", drops=drops)
            elif stage.startswith("fit/") and int(stage[4:]) in by_version:
                phase = by_version[int(stage[4:])]
                values = {"step": step, "steps": phase.steps, "loss": row["loss"], "workers": 0, "lag": 0}
                yield self._progress(now, phase, version, stored, **values, stage="fit", drops={})

    def _progress(self, now: float, phase: Any, version: int, stored: int, **values: Any) -> Message:
        common = {"phase": phase.stage, "round": phase.round, "version": version, "trajectories": stored, "doing": []}
        return self._message(now, "learner", "learner", **common, **values)

    def _from_dataset(self) -> Iterator[Message]:
        episodes: Counter[str] = Counter()
        steps: Counter[str] = Counter()
        last_heartbeat: dict[str, float] = {}
        last_episode: dict[str, float] = {}
        for now, row in zip(self._stored_at, self._ordered, strict=True):
            trajectory, worker = self._store.read(row.identity), row.worker
            yield now, self._keys.monitor(f"trajectories/{_key_part(worker)}"), monitor_messages.trajectories([trajectory], now)
            episodes[worker] += 1
            steps[worker] += len(trajectory.actions)
            if now - last_episode.get(worker, 0.0) >= _EPISODE_S:
                last_episode[worker] = now
                yield now, self._keys.monitor(f"episode/{_key_part(worker)}"), monitor_messages.episode(trajectory, now)
            if now - last_heartbeat.get(worker, 0.0) >= _HEARTBEAT_S:
                last_heartbeat[worker] = now
                yield self._heartbeat(now, row, episodes[worker], steps[worker])

    def _heartbeat(self, now: float, row: Row, episodes: int, steps: int) -> Message:
        job = "/".join(map(str, row.identity[:3]))
        counts = {"episodes": episodes, "trajectories": episodes, "steps": steps, "resent": 0, "pid": 0}
        fields = {
            "worker": row.worker,
            "job": job,
            "doing": "",
            "policy_version": row.policy_version,
            "memory_mb": 0.0,
            "peak_mb": 0.0,
        }
        return self._message(now, f"worker/{_key_part(row.worker)}", "worker", **fields, **counts)

    def _message(self, now: float, topic: str, kind: str, **fields: Any) -> Message:
        return now, self._keys.monitor(topic), wire.encode_message(kind, time=now, **fields)


def _key_part(worker: str) -> str:
    """A worker's name as part of a key: characters that a key may not contain become ``_``."""
    return "".join(c if c.isprintable() and c not in "/*$?#" else "_" for c in worker) or "_"
