"""When a run's overseer is woken, and when let sleep again."""

import pytest

from icrl_dist.config.run import ConfigError, load, parse
from icrl_dist.config.sections import AlertsConfig
from icrl_dist.telemetry.alerts import Alerts


def told(alerts, silent=None, now=0.0):
    return [(alert.name, alert.active) for alert in alerts.check(silent or {}, now)]


def test_returns_that_collapse_after_an_update():
    alerts = Alerts(AlertsConfig(collapse=0.5))
    for trial in range(30):
        alerts.returned((0, 0, trial), 0, 1.0 + trial)
    for trial in range(19):
        alerts.returned((0, 0, trial), 1, 0.1)
    assert told(alerts) == [], "19 pairs are too few"
    alerts.returned((0, 0, 19), 1, 0.1)
    (alert,) = alerts.check({}, 0.0)
    assert (alert.name, alert.active) == ("collapse", True)
    assert "T^1 earns 0.1, T^0 10.5 in the same 20 trials" in alert.text
    assert told(alerts) == [], "it is told once"
    for trial in range(20):
        alerts.returned((0, 0, trial), 2, 9.0)
    assert told(alerts) == [("collapse", False)]


def test_early_trials_of_a_round_are_compared_with_early_trials():
    """Every round begins from empty contexts, and so with low returns."""
    alerts = Alerts(AlertsConfig())
    for trial in range(40):
        alerts.returned((0, 0, trial), 0, float(trial))
    for trial in range(25):
        alerts.returned((0, 0, trial), 1, 0.9 * trial)
    assert told(alerts) == []


def test_a_variation_that_is_stuck_at_zero():
    alerts = Alerts(AlertsConfig(zero_episodes=3))
    for trial in range(2):
        alerts.returned((1, 0, trial), 0, 0.0)
    assert told(alerts) == []
    for variation in range(5):
        for trial in range(3):
            alerts.returned((1, variation, 5 + trial), 0, 0.0)
    (alert,) = alerts.check({}, 0.0)
    assert alert.text == "stuck at zero for 3 episodes: variation 1/0, 1/1, 1/2 and 2 more"
    for variation in range(5):
        alerts.returned((1, variation, 9), 0, 1.0)
    assert told(alerts) == [("zero", False)]


def test_what_changes_is_said_again_but_not_all_the_time_and_always_known():
    alerts = Alerts(AlertsConfig(zero_episodes=1))
    said = []
    for second in range(65):
        alerts.returned((1, second, 0), 0, 0.0)
        said += [(second, alert.text) for alert in alerts.check({}, float(second))]
        (on,) = alerts.on
        assert on.since == 0.0 and f"1/{min(second, 2)}" in on.text, "it is known as it is now"
    assert [second for second, _ in said] == [0, 30, 60]
    assert said[1][1].endswith("variation 1/0, 1/1, 1/2 and 28 more")
    assert [second for second in range(65, 200) if told(alerts, now=float(second))] == [90], "then nothing changed"
    for second in range(65):
        alerts.returned((1, second, 0), 0, 1.0)
    (over,) = alerts.check({}, 200.0)
    assert over.text == "over: stuck at zero for 1 episodes: variation 1/0, 1/1, 1/2 and 62 more" and not alerts.on


def test_a_worker_that_is_silent_and_heard_of_again():
    alerts = Alerts(AlertsConfig(silent_s=5.0))
    assert told(alerts, {"w0": 4.9, "w1": 0.1}) == []
    assert told(alerts, {"w0": 5.1, "w1": 0.1}) == [("silent w0", True)]
    assert told(alerts, {"w0": 0.2, "w1": 9.0}) == [("silent w0", False), ("silent w1", True)]


def test_ingest_that_falls_behind_the_workers():
    alerts = Alerts(AlertsConfig(ingest=0.5))
    for second in range(10):
        alerts.waited(float(second), {"w0": 0.8 * second, "w1": 0.6 * second})
    assert told(alerts) == [], "ten seconds have not passed"
    alerts.waited(10.0, {"w0": 8.0, "w1": 6.0})
    (alert,) = alerts.check({}, 0.0)
    assert alert.text == "ingest below demand: workers wait 70% of their time for the learner to store what they sent"
    for second in range(11, 40):
        alerts.waited(float(second), {"w0": 8.0, "w1": 6.0})
    assert told(alerts) == [("ingest", False)]


def test_bursts_and_workers_that_come_and_go_are_no_lack_of_ingest():
    alerts = Alerts(AlertsConfig(ingest=0.5))
    for second in range(60):
        there = {"w0": 4.0 * (second // 10)} | ({"w1": 50.0 + second / 2} if second % 7 else {})
        alerts.waited(float(second), there)
        assert told(alerts) == [], second


def test_label_quality_that_falls_from_round_to_round():
    alerts = Alerts(AlertsConfig(labels=0.05))
    alerts.labels(0, 0.90)
    alerts.labels(1, 0.87)
    assert told(alerts) == []
    alerts.labels(2, 0.80)
    (alert,) = alerts.check({}, 0.0)
    assert alert.text == "label quality falls: 80% of round 2's labels are optimal, 87% of round 1's"


def test_nought_is_never():
    alerts = Alerts(AlertsConfig(collapse=0, zero_episodes=0, silent_s=0, ingest=0, labels=0))
    for trial in range(50):
        alerts.returned((0, 0, trial), 0, 5.0)
        alerts.returned((0, 0, trial), 1, 0.0)
        alerts.waited(float(trial), {"w0": float(trial)})
    alerts.labels(0, 1.0)
    alerts.labels(1, 0.0)
    assert told(alerts, {"w0": 1e9}) == []


def test_what_a_phase_earned_before_does_not_count_in_the_next():
    alerts = Alerts(AlertsConfig(zero_episodes=3))
    for trial in range(2):
        alerts.returned((0, 0, trial), -1, 0.0)
    alerts.began()
    alerts.returned((0, 0, 0), 0, 0.0)
    assert told(alerts) == []


def test_thresholds_are_numbers_of_the_run_file():
    assert parse("[alerts]\ncollapse = 0.25", "x").alerts.collapse == 0.25
    assert load("demo").alerts == AlertsConfig()
    for line, what in (
        ("collapse = 2.0", "alerts.collapse = 2.0"),
        ("silent_s = -1.0", "alerts.silent_s"),
        ("ingest = nan", "ingest"),
    ):
        with pytest.raises(ConfigError, match=what):
            parse(f"[alerts]\n{line}", "x")
