"""A run's metrics, by one list of names: written to ``metrics.jsonl``, copied to TensorBoard and Prometheus."""

from __future__ import annotations

import contextlib
import time
from collections import defaultdict
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from icrl_dist.storage.files import unwritten
from icrl_dist.telemetry import event_files, metric_rows
from icrl_dist.telemetry.alerts import KINDS, alert_kind

if TYPE_CHECKING:
    from torch.utils.tensorboard.writer import SummaryWriter

STAGES = {
    "collect": "once a phase is collected; `step` is the version that will be fitted to it",
    "ingest": "once a second while a phase is collected, later in a run at most every 3600th part of its time and at least "
    "once a minute; `step` is the version that will be fitted to it, in TensorBoard the number of stored trajectories",
    "labels": "once a round is collected whose labels are the model's own, in Dark Room; `step` is the round",
    "fit": "every 50 optimizer steps, as stage `fit/VERSION`; `step` is the optimizer step",
    "version": "once a version of the weights is fitted; `step` is the version",
    "heldout": "once a run is evaluated, as stage `heldout/pP/AGENT`: AGENT is `model` for the policy versions, else the key "
    "of a reference; `step` is the version",
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
    "heldout": {
        "return": "mean return of the last 5 episodes of an evaluation",
        "low": "lower end of its 95% interval, over tasks and evaluations of this one training",
        "high": "upper end of that interval",
    },
}
"""Every metric of a run: its stage, its name, its description."""

SERIES = ("ingest",)
"""Stages that have several rows of one step."""

TEXTS = ("event", "alert")
"""Stages whose rows hold no numbers but ``what`` happened and its ``text``, and for an alert whether it is ``active``."""


@dataclass(frozen=True)
class HeldOut:
    """The return of one agent on held-out tasks at one p."""

    p: float
    agent: str
    """``model`` for every policy version; else the key of a reference."""
    version: int
    """The policy version; of a reference the newest one that was evaluated with it."""
    values: dict[str, float]
    """By the names in ``NAMES["heldout"]``; ``low`` and ``high`` only if there is an interval."""

    @property
    def stage(self) -> str:
        return f"heldout/p{self.p:g}/{self.agent}"


class Metrics:
    """Appends rows to the files of ``metric_rows``, and optionally to TensorBoard events and a Prometheus endpoint.

    A number is written once for each step of its stage: a step that is written already is left out, and what a resumed
    run will fit again is removed by ``continue_from``.  Writing raises StoreError if a row cannot be written.
    """

    def __init__(self, folder: Path, tensorboard: bool = True, prometheus: str = "") -> None:
        """``prometheus``: HOST:PORT at which the newest values are served.  Raises LinkError if that port is not free."""
        self._folder, self._events = folder, folder / "tensorboard"
        self._exporter = None
        if prometheus:
            from icrl_dist.telemetry.prometheus import Exporter

            self._exporter = Exporter(prometheus, folder.name, NAMES, STAGES)
        with _writing(folder / metric_rows.NAME):
            self._rows = metric_rows.RowWriter(folder)
        self._tensorboard: SummaryWriter | None = None
        if tensorboard:
            from torch.utils.tensorboard import writer  # noqa: F401  # slow to import: now, not at the first number
        self._uses_tensorboard = tensorboard
        self._read_last()
        for name, (step, text) in list(self._alerts.items()):
            self.write_text(time.time(), step, "alert", what=name, active=False, text=f"over: the learner has ended ({text})")

    def _read_last(self) -> None:
        """Read the steps of each stage, and the alerts that are still active, from what is written."""
        self._steps = defaultdict[str, set[float]](set)
        self._alerts: dict[str, tuple[int, str]] = {}
        for row in metric_rows.read(self._folder):
            stage = row["stage"]
            if stage == "alert":
                self._change_alert(str(row.get("what")), bool(row.get("active")), row["step"], str(row.get("text")))
            elif stage not in TEXTS:
                self._is_new(stage, row.get("trajectories", 0) if stage in SERIES else row["step"])
        self._changes = event_files.last_step(self._events, "alert/")

    def _is_new(self, stage: str, step: float) -> bool:
        """Add a step to those that are written; returns whether it was not written before, in a series whether it is larger."""
        steps = self._steps[stage]
        if step in steps or (stage in SERIES and steps and step < max(steps)):
            return False
        if stage in SERIES:
            steps.clear()
        steps.add(step)
        return True

    def _change_alert(self, name: str, active: bool, step: int, text: str) -> None:
        if active:
            self._alerts[name] = step, text
        else:
            self._alerts.pop(name, None)

    def continue_from(self, version: int, step: int) -> None:
        """Remove the rows of what will be fitted again, before it is fitted.

        ``version``: the newest policy version; ``step``: the optimizer steps of the next version that are done.
        """

        fitted, next_version = f"fit/{version + 1}", version + 1

        def superseded(stage: str, of: float) -> bool:
            return (stage == fitted and of > step) or (stage == "version" and of == next_version)

        if next_version in self._steps["version"] or any(of > step for of in self._steps[fitted]):
            self._remove(superseded)

    def _remove(self, superseded: Callable[[str, float], bool]) -> None:
        with _writing(self._folder / metric_rows.NAME):
            self._rows.remove(lambda row: superseded(row["stage"], row["step"]))
        with _writing(self._events):
            if self._tensorboard is not None:
                self._tensorboard.close()
                self._tensorboard = None
            event_files.remove(self._events, lambda tag, step: superseded(tag.rpartition("/")[0], step))
        self._read_last()

    def write(self, step: int, stage: str, *, keep: bool = True, **values: float) -> None:
        """Write a row; ``step`` counts within ``stage`` (such as ``fit/1``).

        ``keep``: False for a row that only Prometheus gets.  Raises KeyError for an unknown name.
        """
        kind = stage.partition("/")[0]
        if unknown := values.keys() - NAMES[kind].keys():
            raise KeyError(f"metrics of {stage}: {sorted(unknown)} are not in metrics.NAMES")
        if self._exporter is not None:
            self._exporter.set(kind, step, values)
        if not keep:
            return
        number = values["trajectories"] if kind in SERIES else step
        new = self._is_new(stage, number)
        if new or kind in SERIES:
            self._append(stage, step, values)
        if new:
            self._add_scalars(stage, number, values)

    def write_text(self, at: float, step: int, stage: str, **about: object) -> None:
        """Write a row of text with the time ``at``: ``stage`` is one of ``TEXTS``, ``step`` the newest version.

        An alert also changes the number of active alerts of its kind in TensorBoard and for Prometheus.
        """
        self._append(stage, step, about, at)
        if stage == "alert":
            name = str(about["what"])
            self._change_alert(name, bool(about["active"]), step, str(about["text"]))
            kind = alert_kind(name)
            active = sum(alert_kind(other) == kind for other in self._alerts)
            self._changes += 1
            self._add_scalars("alert", self._changes, {kind: active})
            if self._exporter is not None:
                self._exporter.set_alerts(kind, active)

    def write_heldout(self, returns: Sequence[HeldOut]) -> None:
        """Write the held-out returns of an evaluation in place of those of an earlier one."""
        new = {(one.stage, one.version): one.values for one in returns}
        old = {
            (row["stage"], row["step"]): {name: value for name, value in row.items() if name in NAMES["heldout"]}
            for row in metric_rows.read(self._folder)
            if row["stage"].startswith("heldout/")
        }
        if self._exporter is not None:
            self._exporter.set_heldout(returns)
        if new == old:
            return
        self._remove(lambda stage, step: stage.startswith("heldout/"))
        for (stage, step), values in new.items():
            self._append(stage, step, values)
            self._add_scalars(stage, step, values)

    def wait_until_read(self, timeout_s: float) -> None:
        """Wait until Prometheus has read the present values, if they are served; at most ``timeout_s``."""
        if self._exporter is not None:
            self._exporter.read.clear()
            self._exporter.read.wait(timeout_s)

    def _append(self, stage: str, step: float, values: Mapping[str, object], at: float | None = None) -> None:
        with _writing(self._folder / metric_rows.NAME):
            self._rows.append({"time": round(time.time() if at is None else at, 3), "stage": stage, "step": step, **values})

    def _add_scalars(self, stage: str, step: float, values: Mapping[str, float]) -> None:
        if not self._uses_tensorboard:
            return
        with _writing(self._events):
            if self._tensorboard is None:
                from torch.utils.tensorboard.writer import SummaryWriter

                self._tensorboard = SummaryWriter(str(self._events), flush_secs=10)
            for name, value in values.items():
                self._tensorboard.add_scalar(f"{stage}/{name}", value, int(step))

    def close(self) -> None:
        if self._exporter is not None:
            self._exporter.close()
        self._rows.close()
        if self._tensorboard is not None:
            with _writing(self._events):
                self._tensorboard.close()


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
        "No step of a number is there twice: a resumed run removes the rows of what it fits again. [run-folder.md]"
        "(run-folder.md#metrics-and-logs) gives the sizes of the files. "
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
        "",
        "The number of active alerts is in TensorBoard as `alert/KIND`, where the step is the number of the change, and for "
        f'Prometheus as `icrl_alert_active{{run="...", alert="KIND"}}`. KIND is {_listed(KINDS)}.',
        "",
        'Held-out returns have the labels `p`, `agent` and `version` for Prometheus, as in `icrl_heldout_return{run="...", '
        'p="0.2", agent="model", version="2"}`. The evaluation serves them at the same address as the learner, and waits at '
        "most a minute at its end until they were read.",
    ]
    return "\n".join(lines) + "\n"


def _listed(names: Sequence[str]) -> str:
    quoted = [f"`{name}`" for name in names]
    return f"{', '.join(quoted[:-1])} or {quoted[-1]}"


if __name__ == "__main__":
    print(document(), end="")
