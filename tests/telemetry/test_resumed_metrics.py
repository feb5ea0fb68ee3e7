"""Metrics of a run with several sessions: no step twice, in no file, and files that stay small."""

import json
import math
import os

import pytest
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from icrl_dist.storage.files import StoreError
from icrl_dist.telemetry import metric_rows
from icrl_dist.telemetry.metrics import HeldOut, Metrics


def rows_of(folder, *names):
    return [tuple(row.get(name) for name in ("stage", "step", *names)) for row in metric_rows.read(folder)]


def scalars(folder):
    """Name and step of all numbers as TensorBoard shows them; more than one event file may hold a name."""
    found = []
    for file in sorted((folder / "tensorboard").iterdir()):
        shown = EventAccumulator(str(file), size_guidance={"scalars": 0}).Reload()
        found += [(tag, one.step, one.value) for tag in shown.Tags()["scalars"] for one in shown.Scalars(tag)]
    return found


def test_a_resumed_run_replaces_the_steps_that_it_fits_again(tmp_path):
    first = Metrics(tmp_path)
    for step in range(50, 351, 50):
        first.write(step, "fit/0", loss=1.0)
    first.write(0, "version", loss=1.0, seconds=3.0)
    for step in (50, 100, 150):
        first.write(step, "fit/1", loss=2.0)
    first.close()  # as after a kill: the checkpoint is of step 100
    again = Metrics(tmp_path)
    again.continue_from(version=0, step=100)
    for step in (150, 200):
        again.write(step, "fit/1", loss=3.0)
    again.close()
    losses = [(f"fit/{v}", step) for v, steps in ((0, range(50, 351, 50)), (1, (50, 100, 150, 200))) for step in steps]
    found = [row for row in rows_of(tmp_path, "loss") if row[0].startswith("fit/")]
    assert [row[:2] for row in found] == losses and found[-2:] == [("fit/1", 150, 3.0), ("fit/1", 200, 3.0)]
    shown = [one for one in scalars(tmp_path) if one[0].startswith("fit/")]
    assert sorted(shown) == sorted((f"{stage}/loss", step, loss) for stage, step, loss in found)


def test_a_version_that_is_lost_is_fitted_again(tmp_path):
    written = Metrics(tmp_path, tensorboard=False)
    for version in range(3):
        written.write(50, f"fit/{version}", loss=1.0)
        written.write(version, "version", loss=1.0, seconds=1.0)
    written.continue_from(version=0, step=0)  # the checkpoint of T^1 was damaged, that of T^2 is intact
    assert rows_of(tmp_path) == [("fit/0", 50), ("version", 0), ("fit/2", 50), ("version", 2)]
    written.write(50, "fit/1", loss=1.0)
    written.write(1, "version", loss=1.0, seconds=1.0)
    written.close()
    assert rows_of(tmp_path)[-2:] == [("fit/1", 50), ("version", 1)]


def test_a_phase_that_is_collected_again_keeps_its_first_numbers(tmp_path):
    for per_s in (90.0, 0.0):
        written = Metrics(tmp_path)
        written.write(0, "collect", trajectories=280, per_s=per_s, leases=7)
        written.close()
    assert rows_of(tmp_path, "per_s") == [("collect", 0, 90.0)]
    assert [step for tag, step, _ in scalars(tmp_path) if tag == "collect/per_s"] == [0]


def test_ingest_is_a_series_whose_step_in_tensorboard_is_the_number_of_trajectories(tmp_path):
    written = Metrics(tmp_path)
    for stored in (10, 10, 20):
        written.write(0, "ingest", trajectories=stored, workers=2)
    written.write(0, "ingest", keep=False, trajectories=25, workers=2)
    written.close()
    assert rows_of(tmp_path, "trajectories") == [("ingest", 0, 10), ("ingest", 0, 10), ("ingest", 0, 20)]
    assert [step for tag, step, _ in scalars(tmp_path) if tag == "ingest/workers"] == [10, 20]


def test_alerts_are_counted_by_kind_and_end_with_their_learner(tmp_path):
    def change(metrics, name, active):
        metrics.write_text(1.0, 0, "alert", what=name, active=active, text=f"{name}!")

    first = Metrics(tmp_path)
    for name in ("silent w0", "silent w1", "zero"):
        change(first, name, True)
    change(first, "silent w0", False)
    first.close()
    again = Metrics(tmp_path)
    change(again, "zero", True)
    again.close()
    assert [row[2:] for row in rows_of(tmp_path, "what", "active")] == [
        ("silent w0", True),
        ("silent w1", True),
        ("zero", True),
        ("silent w0", False),
        ("silent w1", False),
        ("zero", False),
        ("zero", True),
    ]
    shown = sorted((step, tag, value) for tag, step, value in scalars(tmp_path))
    names = ["silent", "silent", "zero", "silent", "silent", "zero", "zero"]
    assert shown == [
        (n + 1, f"alert/{name}", value) for n, (name, value) in enumerate(zip(names, [1, 2, 1, 1, 0, 0, 1], strict=True))
    ]


def test_heldout_returns_replace_those_of_an_earlier_evaluation(tmp_path):
    def heldout(value):
        return [HeldOut(0.2, "model", version, {"return": value + version}) for version in (0, 2)]

    for value in (1.0, 1.0, 5.0):
        written = Metrics(tmp_path)
        written.write_heldout(heldout(value))
        written.close()
    assert rows_of(tmp_path, "return") == [("heldout/p0.2/model", 0, 5.0), ("heldout/p0.2/model", 2, 7.0)]
    assert scalars(tmp_path) == [("heldout/p0.2/model/return", 0, 5.0), ("heldout/p0.2/model/return", 2, 7.0)]


def test_rows_of_full_files_are_read_in_order_and_the_oldest_go(tmp_path, monkeypatch):
    monkeypatch.setattr(metric_rows, "MAX_BYTES", 1000)
    written = Metrics(tmp_path, tensorboard=False)
    for step in range(400):
        written.write(step, "fit/0", loss=1.0)
    names = {"metrics.jsonl", *(f"metrics.jsonl.{number}" for number in range(1, metric_rows.OLDER + 1))}
    assert {path.name for path in tmp_path.iterdir()} == names
    assert sum(path.stat().st_size for path in tmp_path.iterdir()) <= 1000 * (metric_rows.OLDER + 1)
    steps = [step for _, step in rows_of(tmp_path)]
    assert steps == list(range(steps[0], 400)) and steps[0] > 0
    written.continue_from(version=-1, step=380)
    assert [step for _, step in rows_of(tmp_path)] == list(range(steps[0], 381)), "also in older files"
    written.close()


@pytest.mark.parametrize("torn", ['{"time": 1.5, "sta', '{"time": 1.5, "stage": "fit/0", "step": 100}'])
def test_a_line_that_was_written_in_part_does_not_spoil_the_next(tmp_path, torn):
    line = json.dumps({"time": 1.0, "stage": "fit/0", "step": 50, "loss": 1.0}) + "\n"
    (tmp_path / metric_rows.NAME).write_text(line + torn)
    written = Metrics(tmp_path, tensorboard=False)
    written.write(100, "fit/0", loss=0.5)
    written.close()
    assert rows_of(tmp_path, "loss") == [("fit/0", 50, 1.0), ("fit/0", 100, 0.5)]


def test_a_full_disk_leaves_no_half_row(tmp_path, monkeypatch):
    written = Metrics(tmp_path, tensorboard=False)
    written.write(50, "fit/0", loss=1.0)
    raw = written._rows._file

    class Full:
        """A file on a disk that has room for eight more bytes."""

        def __getattr__(self, name):
            return getattr(raw, name)

        def write(self, line):
            return raw.write(line[:8])

    monkeypatch.setattr(written._rows, "_file", Full())
    with pytest.raises(StoreError, match="No space left on device"):
        written.write(100, "fit/0", loss=1.0)
    assert (tmp_path / metric_rows.NAME).read_text().endswith("}\n") and len(rows_of(tmp_path)) == 1
    raw.close()


def test_a_reader_during_a_change_of_files_reads_each_row_once(tmp_path):
    (tmp_path / "metrics.jsonl").write_text('{"time": 1, "stage": "fit/0", "step": 50, "loss": 1}\n')
    os.link(tmp_path / "metrics.jsonl", tmp_path / "metrics.jsonl.1")
    assert rows_of(tmp_path) == [("fit/0", 50)]


@pytest.mark.parametrize(
    "line", ["[]", "1", '{"time": "x", "stage": "fit/0", "step": 1}', '{"time": 1, "stage": 2, "step": 1}', "\0"]
)
def test_lines_that_are_no_rows_are_left_out(tmp_path, line):
    (tmp_path / "metrics.jsonl").write_text(line + "\n")
    assert not list(metric_rows.read(tmp_path))
    written = Metrics(tmp_path, tensorboard=False)
    written.write(1, "fit/0", loss=math.inf)
    written.close()
    assert len(list(metric_rows.read(tmp_path))) == 1
