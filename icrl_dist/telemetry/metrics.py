"""Numbers of a run, by one list of names: ``metrics.jsonl`` is the truth; TensorBoard and Prometheus are views of it."""

from __future__ import annotations

import contextlib
import json
import time
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

from prometheus_client import CollectorRegistry, Gauge, start_http_server

from icrl_dist.storage.files import unwritten
from icrl_dist.stream.link import LinkError

if TYPE_CHECKING:
    from torch.utils.tensorboard.writer import SummaryWriter

STAGES = {
    "collect": "once a phase is collected; `step` is the version that will be fitted to it",
    "ingest": "once a second while a phase is collected; `step` is the version that will be fitted to it",
    "labels": "once a round is collected whose labels are the model's own, in Dark Room; `step` is the round",
    "fit": "every 50 optimizer steps, as stage `fit/VERSION`; `step` is the optimizer step",
    "version": "once a version of the weights is fitted; `step` is the version",
}
"""When a row is written, by the first part of its stage's name."""

NAMES: dict[str, dict[str, str]] = {
    "collect": {
        "trajectories": "trajectories of the phase that are stored",
        "per_s": "of those, stored a second since the phase began",
        "leases": "jobs handed out, those handed out again among them",
    },
    "ingest": {
        "trajectories": "trajectories stored, in all",
        "arrived": "trajectories stored of this phase",
        "episodes": "episodes that workers have finished since they started",
        "workers": "workers alive",
        "unstored": "episodes that workers have finished and the learner has not acknowledged",
        "lag": "versions by which the weights of the last stored trajectory were older than its round",
        "drops": "messages refused or dropped, for any reason",
        "resent": "times that a trajectory had to be sent again",
        "waited_s": "seconds that workers have waited for the learner to store what they sent, all together",
    },
    "labels": {
        "agreement": "share of the labels that the optimal policy would also take, 0 to 1",
        "labelling": "share of the variations that gave labels, 0 to 1",
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
"""Every number that a run writes: its stage, its name, and what it is."""

TEXTS = ("event", "alert")
"""Stages whose rows hold text, ``what`` happened and its ``text``, and no numbers; an alert also whether it is ``active``."""


class Metrics:
    """Appends rows to ``folder/metrics.jsonl`` and, if asked, to TensorBoard events beside it and a Prometheus endpoint.

    Writing raises StoreError if a row cannot be written.
    """

    def __init__(self, folder: Path, tensorboard: bool = True, prometheus: str = "") -> None:
        """``prometheus``: HOST:PORT to serve the newest values at.  Raises LinkError if that port cannot be had."""
        self._rows, self._events = folder / "metrics.jsonl", folder / "tensorboard"
        self._exporter = _Exporter(prometheus, folder.name) if prometheus else None
        with _writing(self._rows):
            self._file = self._rows.open("a", buffering=1)
        self._board: SummaryWriter | None = None
        if tensorboard:
            from torch.utils.tensorboard.writer import SummaryWriter

            with _writing(self._events):
                self._board = SummaryWriter(str(self._events), flush_secs=10)

    def write(self, step: int, stage: str, **values: float) -> None:
        """One row: ``step`` counts within ``stage`` (a name such as ``fit/1``).  Raises KeyError for an unknown name."""
        known = NAMES[stage.partition("/")[0]]
        if unknown := values.keys() - known.keys():
            raise KeyError(f"metrics of {stage}: {sorted(unknown)} are not in metrics.NAMES")
        self._append({"time": round(time.time(), 3), "stage": stage, "step": step, **values})
        if self._exporter is not None:
            self._exporter.set(stage.partition("/")[0], step, values)
        if self._board is not None:
            with _writing(self._events):
                for name, value in values.items():
                    self._board.add_scalar(f"{stage}/{name}", value, step)

    def tell(self, at: float, step: int, stage: str, **about: object) -> None:
        """A row of text of that time: ``stage`` is one of ``TEXTS``, ``step`` the newest version."""
        self._append({"time": round(at, 3), "stage": stage, "step": step, **about})

    def _append(self, row: dict[str, object]) -> None:
        with _writing(self._rows):
            self._file.write(json.dumps(row) + "\n")

    def close(self) -> None:
        if self._exporter is not None:
            self._exporter.close()
        with _writing(self._rows):
            self._file.close()
        if self._board is not None:
            with _writing(self._events):
                self._board.close()


class _Exporter:
    """The newest value of every number, for Prometheus."""

    def __init__(self, endpoint: str, run: str) -> None:
        host, _, port = endpoint.rpartition(":")
        registry = CollectorRegistry()
        self._gauges = {
            (stage, name): Gauge(f"icrl_{stage}_{name}", text, ["run"], registry=registry).labels(run)
            for stage, names in NAMES.items()
            for name, text in {**names, "step": STAGES[stage].partition("`step` is ")[2]}.items()
        }
        try:
            self._server, self._thread = start_http_server(int(port), host.strip("[]"), registry)
        except OSError as error:
            raise LinkError(
                f"learner.prometheus = {endpoint!r}: cannot listen there ({error.strerror}); free that port or name another"
            ) from error

    def set(self, stage: str, step: int, values: dict[str, float]) -> None:
        for name, value in {**values, "step": step}.items():
            self._gauges[stage, name].set(value)

    def close(self) -> None:
        self._server.shutdown()
        self._server.server_close()
        self._thread.join()


@contextlib.contextmanager
def _writing(path: Path) -> Iterator[None]:
    try:
        yield
    except OSError as error:
        raise unwritten(path, error) from error


def document() -> str:
    """docs/metrics.md, from the lists above."""
    lines = [
        "# Metrics",
        "",
        "Every number that a run writes, by stage. `metrics.jsonl` in the run folder holds a JSON object a line: `time` (Unix "
        "seconds), `stage`, `step`, and the numbers. TensorBoard has the same under `STAGE/NAME`; with "
        '`learner.prometheus = "127.0.0.1:9464"` the newest values are served there as `icrl_STAGE_NAME{run="..."}`. '
        "This page is made from the code: `python -m icrl_dist.telemetry.metrics > docs/metrics.md`.",
    ]
    for stage, when in STAGES.items():
        lines += ["", f"## {stage}", "", f"{when[0].upper()}{when[1:]}.", "", "| name | Prometheus | what |", "|---|---|---|"]
        lines += [f"| `{name}` | `icrl_{stage}_{name}` | {text} |" for name, text in NAMES[stage].items()]
    lines += [
        "",
        "## event, alert",
        "",
        "Rows of text: `what` happened (`worker`, `crash`, `quarantine`, `repaired`, `note`, `finished`, ...) and its "
        "`text`; an alert has its name as `what` and whether it is `active`. `step` is the newest version of the weights. "
        "Thresholds of alerts: section `[alerts]` of the run file.",
    ]
    return "\n".join(lines) + "\n"


if __name__ == "__main__":
    print(document(), end="")
