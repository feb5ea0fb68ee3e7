"""A run's metrics, by one list of names: written to ``metrics.jsonl``, copied to TensorBoard and Prometheus."""

from __future__ import annotations

import contextlib
import json
import time
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

from prometheus_client import CollectorRegistry, Gauge

from icrl_dist.storage.files import unwritten
from icrl_dist.stream.link import LinkError
from icrl_dist.telemetry.exporter import MetricsServer

if TYPE_CHECKING:
    from torch.utils.tensorboard.writer import SummaryWriter

STAGES = {
    "collect": "once a phase is collected; `step` is the version that will be fitted to it",
    "ingest": "once a second while a phase is collected; `step` is the version that will be fitted to it",
    "labels": "once a round is collected whose labels are the model's own, in Dark Room; `step` is the round",
    "fit": "every 50 optimizer steps, as stage `fit/VERSION`; `step` is the optimizer step",
    "version": "once a version of the weights is fitted; `step` is the version",
}
"""When rows are written, by the first part of the stage's name."""

NAMES: dict[str, dict[str, str]] = {
    "collect": {
        "trajectories": "trajectories of the phase that are stored",
        "per_s": "of those, stored a second since the phase began",
        "leases": "jobs leased, repeated leases included",
    },
    "ingest": {
        "trajectories": "trajectories stored, in total",
        "arrived": "trajectories stored of this phase",
        "episodes": "episodes that workers have finished since they started",
        "workers": "workers alive",
        "unstored": "episodes that workers have finished and the learner has not acknowledged",
        "lag": "versions by which the weights of the last stored trajectory were older than its round",
        "drops": "messages refused or dropped, for any reason",
        "resent": "times that a trajectory had to be sent again",
        "waited_s": "seconds that workers have waited for the learner to store their trajectories, summed over workers",
    },
    "labels": {
        "agreement": "share of the labels that the optimal policy would also take, 0 to 1",
        "labelling": "share of the variations whose trials gave labels, 0 to 1",
        "context_return": "mean return of the trials that became contexts",
        "label_return": "mean return of the trials that gave labels",
        "optimum": "mean optimal return of the variations",
    },
    "fit": {"loss": "loss of eq. (1) of this optimizer step's batch, nats (squared error or nats of a Gaussian for vectors)"},
    "version": {
        "loss": "loss of the fit's last optimizer step",
        "seconds": "wall time of the fit, seconds",
    },
}
"""Every metric of a run: its stage, its name, its description."""

TEXTS = ("event", "alert")
"""Stages whose rows hold no numbers but ``what`` happened and its ``text``, and for an alert whether it is ``active``."""


class Metrics:
    """Appends rows to ``folder/metrics.jsonl`` and optionally to TensorBoard events and a Prometheus endpoint.

    Writing raises StoreError if a row cannot be written.
    """

    def __init__(self, folder: Path, tensorboard: bool = True, prometheus: str = "") -> None:
        """``prometheus``: HOST:PORT at which the newest values are served.  Raises LinkError if that port is not free."""
        self._rows, self._events = folder / "metrics.jsonl", folder / "tensorboard"
        self._exporter = _Exporter(prometheus, folder.name) if prometheus else None
        with _writing(self._rows):
            end_half_line(self._rows)
            self._file = self._rows.open("a", buffering=1)
        self._tensorboard: SummaryWriter | None = None
        if tensorboard:
            from torch.utils.tensorboard.writer import SummaryWriter

            with _writing(self._events):
                self._tensorboard = SummaryWriter(str(self._events), flush_secs=10)

    def write(self, step: int, stage: str, **values: float) -> None:
        """Write a row; ``step`` counts within ``stage`` (such as ``fit/1``).  Raises KeyError for an unknown name."""
        known = NAMES[stage.partition("/")[0]]
        if unknown := values.keys() - known.keys():
            raise KeyError(f"metrics of {stage}: {sorted(unknown)} are not in metrics.NAMES")
        self._append({"time": round(time.time(), 3), "stage": stage, "step": step, **values})
        if self._exporter is not None:
            self._exporter.set(stage.partition("/")[0], step, values)
        if self._tensorboard is not None:
            with _writing(self._events):
                for name, value in values.items():
                    self._tensorboard.add_scalar(f"{stage}/{name}", value, step)

    def write_text(self, at: float, step: int, stage: str, **about: object) -> None:
        """Write a row of text with the time ``at``: ``stage`` is one of ``TEXTS``, ``step`` the newest version."""
        self._append({"time": round(at, 3), "stage": stage, "step": step, **about})

    def _append(self, row: dict[str, object]) -> None:
        with _writing(self._rows):
            self._file.write(json.dumps(row) + "\n")

    def close(self) -> None:
        if self._exporter is not None:
            self._exporter.close()
        with _writing(self._rows):
            self._file.close()
        if self._tensorboard is not None:
            with _writing(self._events):
                self._tensorboard.close()


def end_half_line(path: Path) -> None:
    """Cut off a last line without its end, which a kill or a full disk leaves, so that the next row has a line of its own."""
    if not path.is_file():
        return
    with path.open("r+b") as file:
        end = at = file.seek(0, 2)
        tail = b""
        while at and b"\n" not in tail:
            at = max(0, at - 4096)
            file.seek(at)
            tail = file.read(min(4096, end - at)) + tail
        file.truncate(at + tail.rfind(b"\n") + 1)


class _Exporter:
    """Serves the newest value of every metric to Prometheus."""

    def __init__(self, endpoint: str, run: str) -> None:
        host, _, port = endpoint.rpartition(":")
        registry = CollectorRegistry()
        self._gauges = {
            (stage, name): Gauge(f"icrl_{stage}_{name}", text, ["run"], registry=registry).labels(run)
            for stage, names in NAMES.items()
            for name, text in {**names, "step": STAGES[stage].partition("`step` is ")[2]}.items()
        }
        try:
            self._server = MetricsServer(host.strip("[]"), int(port), registry)
        except OSError as error:
            raise LinkError(
                f"learner.prometheus = {endpoint!r}: cannot listen there ({error.strerror}); free that port or choose another"
            ) from error

    def set(self, stage: str, step: int, values: dict[str, float]) -> None:
        for name, value in {**values, "step": step}.items():
            self._gauges[stage, name].set(value)

    def close(self) -> None:
        self._server.close()


@contextlib.contextmanager
def _writing(path: Path) -> Iterator[None]:
    try:
        yield
    except OSError as error:
        raise unwritten(path, error) from error


def document() -> str:
    """The text of docs/metrics.md, from the lists above."""
    lines = [
        "# Metrics",
        "",
        "All metrics of a run, by stage. `metrics.jsonl` in the run folder holds one JSON object a line: `time` (Unix "
        "seconds), `stage`, `step`, and the numbers. TensorBoard has the same under `STAGE/NAME`; with "
        '`learner.prometheus = "127.0.0.1:9464"` the newest values are served there as `icrl_STAGE_NAME{run="..."}`. '
        "This page is generated: `python -m icrl_dist.telemetry.metrics > docs/metrics.md`.",
    ]
    for stage, when in STAGES.items():
        lines += [
            "",
            f"## {stage}",
            "",
            f"{when[0].upper()}{when[1:]}.",
            "",
            "| name | Prometheus | description |",
            "|---|---|---|",
        ]
        lines += [f"| `{name}` | `icrl_{stage}_{name}` | {text} |" for name, text in NAMES[stage].items()]
    lines += [
        "",
        "## event, alert",
        "",
        "Rows of text: `what` happened (`worker`, `crash`, `quarantine`, `repaired`, `note`, `finished`, ...) and its "
        "`text`. An alert has its name as `what` and whether it is `active`. `step` is the newest version of the weights. "
        "Thresholds of alerts: section `[alerts]` of the run file.",
    ]
    return "\n".join(lines) + "\n"


if __name__ == "__main__":
    print(document(), end="")
