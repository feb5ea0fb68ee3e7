"""What a run has done so far, as monitor messages in pages of bounded size: for views that join late.

A request names either nothing, for what ``metrics.jsonl`` holds (description, progress, events), or a phase and the last
variation that is known, for returns.  It is answered from the index of the dataset and from the trajectories of one page.
"""

from __future__ import annotations

import re
import time
from collections import defaultdict
from collections.abc import Sequence
from pathlib import Path

from icrl_dist.config.run import Run
from icrl_dist.monitor.metric_messages import Message, MetricMessages, Row
from icrl_dist.storage.dataset import Dataset
from icrl_dist.stream import monitor_messages, wire
from icrl_dist.stream.excerpts import show
from icrl_dist.stream.link import StreamKeys
from icrl_dist.stream.validation import WireError, as_list, text, typed
from icrl_dist.telemetry import metric_rows
from icrl_dist.types import Trajectory

REQUEST_BYTES = 512
"""Larger requests are refused."""
_REPLY_BYTES = 1 << 20
"""Larger replies are ignored."""
_TRIALS = 256
"""Returns of one variation in one phase, the newest: as many as a view keeps."""
_PAGE = (48, 512)
"""Variations and trajectories of one page; it ends after the variation that reaches either number."""
_METRICS_BYTES = 4 << 20
"""Bytes at the end of the metrics that are read."""
_PROGRESS_S = 900.0
"""Seconds of progress with every row, as long as a view keeps every second."""
_MAX_PROGRESS = 1200
_MAX_OLDER = 900
"""Rows of progress before that, at equal distances."""
_MAX_EVENTS = 200


def request(phase: str = "", after: str = "") -> bytes:
    """A request for metrics, or for returns of ``phase`` (``adapt/1``) after the variation ``after`` (``TASK/VARIATION``)."""
    return wire.encode_message("past", phase=phase, after=after)


def parse_reply(reply: bytes) -> tuple[list[Message], str]:
    """Messages of a reply, and the variation after which the next page begins; empty at the end.  Raises WireError."""
    kind, fields = wire.decode_message(reply, _REPLY_BYTES)
    found: list[Message] = []
    for one in as_list(fields.get("messages"), "messages"):
        at, key, payload = as_list(one, "messages", 3)
        found.append((typed(at, float, "time"), text(key, "key"), typed(payload, bytes, "payload")))
    if kind != "past":
        raise WireError("schema", f"a reply of kind {show(kind)}, expected past")
    return found, text(fields.get("after"), "after")


def apart_s(times: Sequence[float]) -> float:
    """How far apart the older messages of progress in a reply for metrics are, in seconds, from its times in order."""
    return max(0.0, times[-1] - times[0] - _PROGRESS_S) / _MAX_OLDER if times else 0.0


def _thinned(rows: list[Row], most: int) -> list[Row]:
    """At most ``most`` of the rows, the newest always."""
    every = -(-len(rows) // most) or 1
    return rows[::-1][::every][::-1]


class Past:
    """Answers requests about one run, from its folder and its open dataset."""

    def __init__(self, run: Run, folder: Path, store: Dataset) -> None:
        self._folder, self._store, self._keys = folder, store, StreamKeys(folder.absolute().name)
        self._made = MetricMessages(run, self._keys)

    def answer(self, payload: bytes) -> bytes:
        """The reply to a request: one page.  Raises WireError if the request is not valid."""
        kind, fields = wire.decode_message(payload, REQUEST_BYTES)
        phase, after = text(fields.get("phase"), "phase"), text(fields.get("after"), "after")
        if kind != "past":
            raise WireError("schema", f"a request of kind {show(kind)}, expected past")
        if not phase:
            return _reply(self._metrics(), "")
        if not re.fullmatch(r"(pretrain|adapt)/\d{1,9}", phase) or not re.fullmatch(r"(\d{1,9}/\d{1,9})?", after):
            raise WireError("schema", "phase must be as adapt/1, after as TASK/VARIATION or empty")
        stage, _, number = phase.partition("/")
        return _reply(*self._returns(stage, int(number), tuple(map(int, after.split("/"))) if after else (-1,)))

    def _metrics(self) -> list[Message]:
        rows = sorted(metric_rows.read(self._folder, _METRICS_BYTES), key=lambda row: float(row["time"]))
        events = [row for row in rows if row["stage"] in ("event", "alert")][-_MAX_EVENTS:]
        newest = rows[-1]["time"] if rows else 0.0
        progress = [row for row in rows if row["stage"] == "ingest" or row["stage"].startswith("fit/")]
        late = [row for row in progress if newest - row["time"] <= _PROGRESS_S]
        kept = [*_thinned(progress[: len(progress) - len(late)], _MAX_OLDER), *_thinned(late, _MAX_PROGRESS)]
        began = (self._folder / "run.toml").stat().st_mtime
        first = min([newest, *(row["time"] for row in (*kept, *events))])
        return [
            self._made.description(first, began),
            *self._made.of(sorted([*kept, *events], key=lambda row: float(row["time"]))),
        ]

    def _returns(self, stage: str, number: int, after: tuple[int, ...]) -> tuple[list[Message], str]:
        by_worker: dict[str, list[Trajectory]] = defaultdict(list)
        left = [key for key in self._store.variations(stage, number) if key[2:] > after]
        read = trajectories = 0
        while read < min(len(left), _PAGE[0]) and trajectories < _PAGE[1]:
            for row in self._store.index.trials(left[read])[-_TRIALS:]:
                by_worker[row.worker].append(self._store.read(row.identity))
                trajectories += 1
            read += 1
        topic, unknown = self._keys.monitor("trajectories/past"), 0.0
        messages = [(time.time(), topic, monitor_messages.trajectories(found, unknown)) for found in by_worker.values()]
        return messages, "{2}/{3}".format(*left[read - 1]) if read < len(left) else ""


def _reply(messages: list[Message], after: str) -> bytes:
    return wire.encode_message("past", messages=[[float(at), key, payload] for at, key, payload in messages], after=after)
