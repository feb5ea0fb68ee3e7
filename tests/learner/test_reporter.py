"""What a run says of itself while it is on: to monitors, and in its metrics."""

import dataclasses
import json

import pytest

from icrl_dist.launch import train as launch
from icrl_dist.stream import monitor_messages, wire
from icrl_dist.stream.memory_link import MemoryLink
from icrl_dist.telemetry.alerts import AlertsConfig
from icrl_dist.telemetry.metrics import NAMES, TEXTS
from learner import reporter, service

METRICS = service.Metrics


@pytest.fixture
def said(small_run, tmp_path, monkeypatch):
    """``said(**thresholds)``: a run's monitor messages, its metrics' rows, and the terminal's events."""

    def train(**thresholds):
        heard, events, publish = [], [], MemoryLink.publish

        def listen(link, key, payload, droppable):
            if "/mon/" in key:
                heard.append((key.split("/mon/")[1], *wire.decode_message(payload)))
            publish(link, key, payload, droppable)

        monkeypatch.setattr(MemoryLink, "publish", listen)
        monkeypatch.setattr(reporter, "PERIOD_S", 0.0)
        monkeypatch.setattr(reporter, "_DESCRIPTION_S", 0.0)
        monkeypatch.setattr(service, "Metrics", lambda folder, **options: METRICS(folder, tensorboard=False, **options))
        run = dataclasses.replace(small_run, alerts=AlertsConfig(**thresholds))
        launch.prepare(run, tmp_path / "said", resume=False, overwrite=False)
        launch.train_inline(run, tmp_path / "said", events.append)
        rows = [json.loads(line) for line in (tmp_path / "said" / "metrics.jsonl").read_text().splitlines()]
        return heard, rows, events

    return train


def test_monitors_are_told_all_that_docs_say(said):
    heard, rows, _ = said()
    of = {kind: [fields for _, found, fields in heard if found == kind] for _, kind, _ in heard}
    assert of.keys() == {"trajectories", "episode", "worker", "learner", "run", "event"}
    (about, *_) = of["run"]
    assert (about["method"], about["problem"], about["rounds"]) == ("icaa", "darkroom", 2)
    assert (about["tasks"], about["variations"]) == (7, 21)
    assert about["phases"] == [["pretrain", 0, 10], ["adapt", 0, 5], ["adapt", 1, 5]]
    assert [e["version"] for e in of["event"] if e["what"] == "version"] == [0, 1, 2]
    assert of["event"][-1]["what"] in ("finished", "worker")
    assert {row["stage"].partition("/")[0] for row in rows} <= {*NAMES, *TEXTS}
    stored = [row["trajectories"] for row in rows if row["stage"] == "ingest"]
    told = [one["identity"] for fields in of["trajectories"] for one in monitor_messages.rows(fields)]
    assert stored == sorted(stored) and stored[-1] == len(told) == len(set(told))
    assert len(of["episode"]) < len(told), "only some are shown whole"
    assert len(of["trajectories"]) < len(told) / 2, "a message tells of many"


def test_an_alert_reaches_terminal_monitors_and_metrics(said):
    heard, rows, events = said(zero_episodes=1)
    alerts = [fields for topic, _, fields in heard if topic == "event" and fields["what"] == "alert"]
    assert alerts and alerts[0]["alert"] == "zero" and alerts[0]["active"] is True
    written = [row for row in rows if row["stage"] == "alert"]
    assert [(row["what"], row["active"], row["text"]) for row in written] == [
        (a["alert"], a["active"], a["text"]) for a in alerts
    ]
    (*_, last) = [fields["alerts"] for _, kind, fields in heard if kind == "run"]
    assert {*last[0]} == {"name", "text", "since"} and last[0]["name"] == "zero", "a viewer that comes late is told, too"
    shown = [event["text"] for event in events if event["event"] == "alert"]
    assert shown[0].startswith("ALERT: stuck at zero for 1 episodes: variation ")
