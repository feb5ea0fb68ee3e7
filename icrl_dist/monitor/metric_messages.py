"""Monitor messages made from rows of ``metrics.jsonl``, for recordings and for views that join late."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

from icrl_dist.config.run import Run
from icrl_dist.methods import registry as methods
from icrl_dist.stream import wire
from icrl_dist.stream.link import StreamKeys
from icrl_dist.telemetry.about import about

Message = tuple[float, str, bytes]
"""Time (Unix seconds), key and payload."""
Row = dict[str, Any]


class MetricMessages:
    """Makes messages of a run from its rows."""

    def __init__(self, run: Run, keys: StreamKeys) -> None:
        self._keys, method = keys, methods.of(run)
        phases = method.phases(run)
        jobs = {phase.next_version: method.ask(run, phase) for phase in phases}
        self._phases = {phase.next_version: phase for phase in phases}
        self._expected = {version: sum(job.trials * len(job.variations) for job in some) for version, some in jobs.items()}
        self._about = about(run, phases, [job for some in jobs.values() for job in some])

    def description(self, now: float, began: float) -> Message:
        """The message ``run``, without alerts."""
        return self._message(now, "run", "run", **self._about, began=began)

    def of(self, rows: Sequence[Row]) -> Iterator[Message]:
        """The messages ``learner`` and ``event`` of rows, in their order."""
        version, stored = -1, 0
        for row in rows:
            now, stage, step = row["time"], row["stage"], row["step"]
            if stage in ("event", "alert"):
                fields = {name: row[name] for name in ("worker", "alive", "identity", "active", "version") if name in row}
                what = {"what": "alert", "alert": row["what"]} if stage == "alert" else {"what": row["what"]}
                yield self._message(now, "event", "event", text=row["text"], **fields, **what)
            elif stage == "version":
                version = step
            elif stage == "ingest" and step in self._phases:
                version, stored = step - 1, row["trajectories"]
                drops = {"all": int(row["drops"])} if row["drops"] else {}
                values = {"step": row["arrived"], "steps": self._expected[step], "workers": row["workers"], "lag": row["lag"]}
                yield self._progress(now, step, version, stored, **values, stage="collect", drops=drops)
            elif stage.startswith("fit/") and int(stage[4:]) in self._phases:
                values = {"step": step, "steps": self._phases[int(stage[4:])].steps, "loss": row["loss"]}
                version = int(stage[4:]) - 1
                yield self._progress(now, int(stage[4:]), version, stored, **values, workers=0, lag=0, stage="fit", drops={})

    def _progress(self, now: float, next_version: int, version: int, stored: int, **values: Any) -> Message:
        phase = self._phases[next_version]
        common = {"phase": phase.stage, "round": phase.round, "version": version, "trajectories": stored, "doing": []}
        return self._message(now, "learner", "learner", **common, **values)

    def _message(self, now: float, topic: str, kind: str, **fields: Any) -> Message:
        return now, self._keys.monitor(topic), wire.encode_message(kind, time=now, **fields)
