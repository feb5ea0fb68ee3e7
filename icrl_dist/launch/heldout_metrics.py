"""The held-out returns of a run as metrics, after the learner has ended."""

from __future__ import annotations

import contextlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from icrl_dist.config.run import Run
from icrl_dist.console.display import ReportEvent
from icrl_dist.results import summaries
from icrl_dist.storage.files import StoreError
from icrl_dist.stream.link import LinkError
from icrl_dist.telemetry.metrics import Metrics

READ_S = 60.0
"""Seconds for which Prometheus can read the returns; it reads once a minute by default."""


def record(run: Run, folder: Path, summary: Mapping[str, Any], report: ReportEvent) -> None:
    """Write the returns in ``summary["rows"]`` to the metrics file and TensorBoard, and serve them to Prometheus.

    A file that cannot be written and a port that is not free are reported and are no error: the results are there.
    """
    where = run.learner.prometheus
    try:
        with contextlib.closing(Metrics(folder, prometheus=where)) as metrics:
            metrics.write_heldout(summaries.heldout_metrics(summary.get("rows", ())))
            if where and summary.get("rows"):
                text = f"held-out returns are served to Prometheus at {where} until they are read, at most {READ_S:.0f} s"
                report({"event": "note", "text": text})
                metrics.wait_until_read(READ_S)
    except (StoreError, LinkError) as error:
        report({"event": "note", "text": f"no metrics of the held-out returns: {error}"})
