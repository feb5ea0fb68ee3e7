"""Metrics in the file, in TensorBoard and at the Prometheus endpoint, by one list of names."""

import contextlib
import json
import re
import socket
import threading
import urllib.request
from pathlib import Path

import pytest

from icrl_dist.config.run import ConfigError, parse
from icrl_dist.stream.link import LinkError
from icrl_dist.telemetry import exporter, metrics
from icrl_dist.telemetry.metrics import NAMES, STAGES, Metrics


def free_port():
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]


def test_a_number_goes_to_the_file_and_to_prometheus(tmp_path):
    folder = tmp_path / "demo"
    folder.mkdir()
    where = f"127.0.0.1:{free_port()}"
    written = Metrics(folder, tensorboard=False, prometheus=where)
    try:
        written.write(50, "fit/3", loss=0.25)
        written.write(100, "fit/3", loss=0.125)
        written.write_text(12.0, 2, "alert", what="zero", active=True, text="stuck")
        with urllib.request.urlopen(f"http://{where}/metrics", timeout=10) as page:
            served = page.read().decode()
        assert 'icrl_fit_loss{run="demo"} 0.125' in served and 'icrl_fit_step{run="demo"} 100.0' in served
        assert "# HELP icrl_ingest_unstored episodes that workers have finished" in served
        with pytest.raises(
            LinkError, match=rf"learner.prometheus = '{re.escape(where)}': cannot listen there .*free that port"
        ):
            Metrics(folder, tensorboard=False, prometheus=where)
    finally:
        written.close()
    rows = [json.loads(line) for line in (folder / "metrics.jsonl").read_text().splitlines()]
    assert [(row["stage"], row["step"], row.get("loss")) for row in rows[:2]] == [("fit/3", 50, 0.25), ("fit/3", 100, 0.125)]
    assert rows[2] == {"time": 12.0, "stage": "alert", "step": 2, "what": "zero", "active": True, "text": "stuck"}


def test_bare_connections_to_the_prometheus_port_use_one_descriptor_and_one_thread(tmp_path, monkeypatch):
    monkeypatch.setattr(exporter._Handler, "timeout", 0.05)
    where = ("127.0.0.1", free_port())
    written = Metrics(tmp_path, tensorboard=False, prometheus=f"127.0.0.1:{where[1]}")
    try:
        threads, ends = threading.active_count(), contextlib.ExitStack()
        with ends, contextlib.suppress(TimeoutError):
            for _ in range(50):
                ends.enter_context(socket.create_connection(where, timeout=0.1))
            assert threading.active_count() == threads
        with urllib.request.urlopen(f"http://127.0.0.1:{where[1]}/metrics", timeout=10) as page:
            assert b"icrl_fit_loss" in page.read()
        assert threading.active_count() == threads
    finally:
        written.close()


def test_a_number_that_is_not_in_the_list_is_refused(tmp_path):
    written = Metrics(tmp_path, tensorboard=False)
    with pytest.raises(KeyError, match="losses"):
        written.write(1, "fit/0", losses=1.0)
    with pytest.raises(KeyError):
        written.write(1, "fitting", loss=1.0)
    written.close()
    assert (tmp_path / "metrics.jsonl").read_text() == ""


def test_the_page_is_generated_from_the_list():
    page = Path(__file__).parents[2] / "docs" / "metrics.md"
    assert page.read_text() == metrics.document(), "run `python -m icrl_dist.telemetry.metrics > docs/metrics.md`"
    assert STAGES.keys() == NAMES.keys()


@pytest.mark.parametrize("where", ["9464", "127.0.0.1:", "127.0.0.1:x", "127.0.0.1:70000", ":9464"])
def test_an_invalid_endpoint_is_refused(where):
    with pytest.raises(ConfigError, match=r"learner.prometheus = .*use HOST:PORT, such as 127.0.0.1:9464"):
        parse(f'[learner]\nprometheus = "{where}"', "x")


@pytest.mark.parametrize("lines", [0, 1, 900])
@pytest.mark.parametrize("half", ["", '{"time": 1.0, "stage": "fi', "x" * 9000])
def test_a_half_last_line_is_cut_off_and_later_rows_have_lines_of_their_own(tmp_path, lines, half):
    path, whole = tmp_path / "metrics.jsonl", '{"time": 1.0}\n' * lines
    path.write_text(whole + half)
    metrics = Metrics(tmp_path, tensorboard=False)
    metrics.write_text(2.0, 0, "event", what="x")
    metrics.close()
    assert path.read_text() == whole + json.dumps({"time": 2.0, "stage": "event", "step": 0, "what": "x"}) + "\n"
