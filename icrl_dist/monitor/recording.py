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

from icrl_dist.config.run import ConfigError, load_folder
from icrl_dist.monitor.metric_messages import Message, MetricMessages
from icrl_dist.monitor.pauses import session_starts, without_pauses
from icrl_dist.storage.dataset import Dataset
from icrl_dist.storage.index import Row
from icrl_dist.stream import monitor_messages, wire
from icrl_dist.stream.link import StreamKeys
from icrl_dist.telemetry import metric_rows

_HEARTBEAT_S = 1.0
"""Time between two heartbeats of a worker."""
_EPISODE_S = 1.0
"""Time between two drawn episodes of a worker."""


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
        made = MetricMessages(self._run, self._keys)
        yield made.description(self.begin, self.begin)
        yield from made.of(self._rows)

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
        payload = wire.encode_message("worker", time=now, **fields, **counts)
        return now, self._keys.monitor(f"worker/{_key_part(row.worker)}"), payload


def _key_part(worker: str) -> str:
    """A worker's name as part of a key: characters that a key may not contain become ``_``."""
    return "".join(c if c.isprintable() and c not in "/*$?#" else "_" for c in worker) or "_"
