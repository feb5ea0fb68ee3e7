"""Held-out returns in the metrics file, in TensorBoard and at the Prometheus endpoint."""

import contextlib
import dataclasses
import threading
import time
import urllib.request
from typing import Any

import pytest
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from icrl_dist.launch import heldout_metrics
from icrl_dist.telemetry import metric_rows
from icrl_dist.telemetry.metrics import Metrics
from tests.telemetry.test_metrics import free_port

ROWS = [
    {"key": "t2", "deployment": "committed", "p": 0.2, "last5": 6.5, "last5_interval": [6.0, 7.0]},
    {"key": "t0", "deployment": "committed", "p": 0.2, "last5": 5.5, "last5_interval": [5.0, 6.0]},
    {"key": "oracle", "deployment": "", "p": 0.2, "last5": 9.0, "last5_interval": [None, None]},
]


@pytest.fixture
def served(small_run):
    where = f"127.0.0.1:{free_port()}"
    return dataclasses.replace(small_run, learner=dataclasses.replace(small_run.learner, prometheus=where)), where


def test_heldout_returns_reach_the_file_tensorboard_and_prometheus(served, tmp_path):
    run, where = served
    pages, notes, ended = list[str](), list[dict[str, Any]](), threading.Event()

    def read():
        while not ended.wait(0.02):
            with contextlib.suppress(OSError), urllib.request.urlopen(f"http://{where}/metrics", timeout=10) as page:
                pages.append(page.read().decode())

    reader = threading.Thread(target=read)
    reader.start()
    began = time.monotonic()
    heldout_metrics.record(run, tmp_path, {"rows": ROWS}, notes.append)
    ended.set()
    reader.join()
    assert time.monotonic() - began < heldout_metrics.READ_S / 2, "it ends when the returns were read"
    assert 'icrl_heldout_return{agent="model",p="0.2",run=' in pages[-1] and 'version="2"} 6.5' in pages[-1]
    rows = [(row["stage"], row["step"], row["return"], row.get("low")) for row in metric_rows.read(tmp_path)]
    model = "heldout/p0.2/model"
    assert rows == [(model, 2, 6.5, 6.0), (model, 0, 5.5, 5.0), ("heldout/p0.2/oracle", 2, 9.0, None)]
    shown = EventAccumulator(str(tmp_path / "tensorboard")).Reload()
    assert {(one.step, one.value) for one in shown.Scalars(f"{model}/return")} == {(0, 5.5), (2, 6.5)}
    assert len(notes) == 1 and where in notes[0]["text"]


def test_a_port_that_is_taken_is_no_error_of_a_finished_run(served, tmp_path):
    run, where = served
    notes = list[dict[str, Any]]()
    with contextlib.closing(Metrics(tmp_path, prometheus=where)):
        heldout_metrics.record(run, tmp_path, {"rows": ROWS}, notes.append)
    assert "no metrics of the held-out returns: learner.prometheus" in notes[0]["text"]
