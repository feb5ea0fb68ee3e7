"""The reporter during a run: messages to monitors, rows of metrics, and events for the terminal."""

import dataclasses
import json
from typing import Any

import numpy as np
import pytest

from icrl_dist.config.sections import AlertsConfig
from icrl_dist.interfaces import LabelQuality, RatedVariation
from icrl_dist.launch import train as launch
from icrl_dist.stream import monitor_messages, wire
from icrl_dist.stream.memory_link import MemoryLink
from icrl_dist.telemetry.metrics import NAMES, TEXTS, Metrics
from learner import reporter, service
from tests.toys.return_to_go import ReturnToGo


@pytest.fixture
def train(small_run, tmp_path, monkeypatch):
    """``train(run, **thresholds)``: a run, by default ``small_run``.

    Returns its monitor messages, rows of metrics, and events for the terminal.
    """

    def run_with(run=None, **thresholds):
        messages, events, publish = [], list[dict[str, Any]](), MemoryLink.publish

        def record(link, key, payload, droppable):
            if "/mon/" in key:
                messages.append((key.split("/mon/")[1], *wire.decode_message(payload)))
            publish(link, key, payload, droppable)

        monkeypatch.setattr(MemoryLink, "publish", record)
        monkeypatch.setattr(reporter, "PERIOD_S", 0.0)
        monkeypatch.setattr(reporter, "_DESCRIPTION_S", 0.0)
        monkeypatch.setattr(service, "Metrics", lambda folder, **options: Metrics(folder, tensorboard=False, **options))
        run = dataclasses.replace(run or small_run, alerts=AlertsConfig(**thresholds))
        launch.prepare(run, tmp_path / "run", resume=False, overwrite=False)
        launch.train_inline(run, tmp_path / "run", events.append)
        rows = [json.loads(line) for line in (tmp_path / "run" / "metrics.jsonl").read_text().splitlines()]
        return messages, rows, events

    return run_with


def test_monitors_receive_all_documented_messages(train):
    messages, rows, _ = train()
    of = {kind: [fields for _, found, fields in messages if found == kind] for _, kind, _ in messages}
    assert of.keys() == {"trajectories", "episode", "worker", "learner", "run", "event"}
    (about, *_) = of["run"]
    assert (about["method"], about["problem"], about["rounds"]) == ("icaa", "darkroom", 2)
    assert (about["tasks"], about["variations"]) == (7, 21)
    assert about["phases"] == [["pretrain", 0, 10], ["adapt", 0, 5], ["adapt", 1, 5]]
    assert [e["version"] for e in of["event"] if e["what"] == "version"] == [0, 1, 2]
    assert of["event"][-1]["what"] in ("finished", "worker")
    assert {row["stage"].partition("/")[0] for row in rows} <= {*NAMES, *TEXTS}
    stored = [row["trajectories"] for row in rows if row["stage"] == "ingest"]
    identities = [one["identity"] for fields in of["trajectories"] for one in monitor_messages.rows(fields)]
    assert stored == sorted(stored) and stored[-1] == len(identities) == len(set(identities))
    assert len(of["episode"]) < len(identities), "only some episodes are published completely"
    assert len(of["trajectories"]) < len(identities) / 2, "a message contains many trajectories"


def test_labels_that_a_method_of_another_package_rates_are_reported(train, toy_run, install):
    returns = []

    class Rated(ReturnToGo):
        def label_quality(self, run, phase, dataset):
            if phase.stage == "adapt":
                for key in dataset.variations("adapt", phase.round):
                    trials = dataset.trials(key)
                    returns.append([trial.episode_return for trial in trials])
                    yield RatedVariation(trials, optimum=4.0, agreement=0.5, context_trials=1)

    run = toy_run(method="return-to-go")
    install(methods={"return-to-go": Rated})
    _, rows, events = train(run)
    early, late = np.mean(returns, axis=0)[:1].mean(), np.mean(returns, axis=0)[1:].mean()
    quality = LabelQuality(agreement=0.5, labelling=1.0, context_return=early, label_return=late, optimum=4.0)
    (shown,) = [event for event in events if event["event"] == "labels"]
    assert (shown.pop("event"), shown.pop("round")) == ("labels", 0)
    assert shown == pytest.approx(dataclasses.asdict(quality))
    (row,) = [row for row in rows if row["stage"] == "labels"]
    assert shown.items() <= row.items() and shown.keys() == NAMES["labels"].keys()


def test_an_alert_reaches_terminal_monitors_and_metrics(train):
    messages, rows, events = train(zero_episodes=1)
    alerts = [fields for topic, _, fields in messages if topic == "event" and fields["what"] == "alert"]
    assert alerts and alerts[0]["alert"] == "zero" and alerts[0]["active"] is True
    written = [row for row in rows if row["stage"] == "alert"]
    assert [(row["what"], row["active"], row["text"]) for row in written] == [
        (a["alert"], a["active"], a["text"]) for a in alerts
    ]
    (*_, last) = [fields["alerts"] for _, kind, fields in messages if kind == "run"]
    assert {*last[0]} == {"name", "text", "since"} and last[0]["name"] == "zero", (
        "a viewer that connects later receives it, too"
    )
    shown = [event["text"] for event in events if event["event"] == "alert"]
    assert shown[0].startswith("ALERT: stuck at zero for 1 episodes: variation ")
