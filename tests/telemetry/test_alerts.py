"""When each alert begins and ends."""

import pytest

from icrl_dist.config.run import ConfigError, load, parse
from icrl_dist.config.sections import AlertsConfig
from icrl_dist.telemetry.alerts import Alerts


def changes(alerts, silent=None, now=0.0):
    return [(alert.name, alert.active) for alert in alerts.check(silent or {}, now)]


def test_returns_that_collapse_after_an_update():
    alerts = Alerts(AlertsConfig(collapse=0.5))
    for trial in range(30):
        alerts.add_return((0, 0, trial), 0, 1.0 + trial)
    for trial in range(19):
        alerts.add_return((0, 0, trial), 1, 0.1)
    assert changes(alerts) == [], "19 pairs are too few"
    alerts.add_return((0, 0, 19), 1, 0.1)
    (alert,) = alerts.check({}, 0.0)
    assert (alert.name, alert.active) == ("collapse", True)
    assert "T^1 returns 0.1, T^0 10.5 in the same 20 trials" in alert.text
    assert changes(alerts) == [], "it is reported once"
    for trial in range(20):
        alerts.add_return((0, 0, trial), 2, 9.0)
    assert changes(alerts) == [("collapse", False)]


def test_early_trials_of_a_round_are_compared_with_early_trials():
    """Every round begins with empty contexts and therefore with low returns."""
    alerts = Alerts(AlertsConfig())
    for trial in range(40):
        alerts.add_return((0, 0, trial), 0, float(trial))
    for trial in range(25):
        alerts.add_return((0, 0, trial), 1, 0.9 * trial)
    assert changes(alerts) == []


def test_a_variation_that_is_stuck_at_zero():
    alerts = Alerts(AlertsConfig(zero_episodes=3))
    for trial in range(2):
        alerts.add_return((1, 0, trial), 0, 0.0)
    assert changes(alerts) == []
    for variation in range(5):
        for trial in range(3):
            alerts.add_return((1, variation, 5 + trial), 0, 0.0)
    (alert,) = alerts.check({}, 0.0)
    assert alert.text == "stuck at zero for 3 episodes: variation 1/0, 1/1, 1/2 and 2 more"
    for variation in range(5):
        alerts.add_return((1, variation, 9), 0, 1.0)
    assert changes(alerts) == [("zero", False)]


def test_a_changed_text_is_reported_every_30_seconds_and_is_always_in_active():
    alerts = Alerts(AlertsConfig(zero_episodes=1))
    reports = []
    for second in range(65):
        alerts.add_return((1, second, 0), 0, 0.0)
        reports += [(second, alert.text) for alert in alerts.check({}, float(second))]
        (active,) = alerts.active
        assert active.since == 0.0 and f"1/{min(second, 2)}" in active.text, "the current text"
    assert [second for second, _ in reports] == [0, 30, 60]
    assert reports[1][1].endswith("variation 1/0, 1/1, 1/2 and 28 more")
    assert [second for second in range(65, 200) if changes(alerts, now=float(second))] == [90], "the text has not changed since"
    for second in range(65):
        alerts.add_return((1, second, 0), 0, 1.0)
    (over,) = alerts.check({}, 200.0)
    assert over.text == "over: stuck at zero for 1 episodes: variation 1/0, 1/1, 1/2 and 62 more" and not alerts.active


def test_a_worker_that_is_silent_and_sends_again():
    alerts = Alerts(AlertsConfig(silent_s=5.0))
    assert changes(alerts, {"w0": 4.9, "w1": 0.1}) == []
    assert changes(alerts, {"w0": 5.1, "w1": 0.1}) == [("silent w0", True)]
    assert changes(alerts, {"w0": 0.2, "w1": 9.0}) == [("silent w0", False), ("silent w1", True)]


def test_ingest_that_falls_behind_the_workers():
    alerts = Alerts(AlertsConfig(ingest=0.5))
    for second in range(10):
        alerts.add_waiting(float(second), {"w0": 0.8 * second, "w1": 0.6 * second})
    assert changes(alerts) == [], "ten seconds have not passed"
    alerts.add_waiting(10.0, {"w0": 8.0, "w1": 6.0})
    (alert,) = alerts.check({}, 0.0)
    assert alert.text == "ingest below demand: workers wait 70% of their time for the learner to store their trajectories"
    for second in range(11, 40):
        alerts.add_waiting(float(second), {"w0": 8.0, "w1": 6.0})
    assert changes(alerts) == [("ingest", False)]


def test_bursts_and_workers_that_come_and_go_raise_no_ingest_alert():
    alerts = Alerts(AlertsConfig(ingest=0.5))
    for second in range(60):
        waited = {"w0": 4.0 * (second // 10)} | ({"w1": 50.0 + second / 2} if second % 7 else {})
        alerts.add_waiting(float(second), waited)
        assert changes(alerts) == [], second


def test_label_quality_that_falls_from_round_to_round():
    alerts = Alerts(AlertsConfig(labels=0.05))
    alerts.add_label_quality(0, 0.90)
    alerts.add_label_quality(1, 0.87)
    assert changes(alerts) == []
    alerts.add_label_quality(2, 0.80)
    (alert,) = alerts.check({}, 0.0)
    assert alert.text == "label quality falls: 80% of adapt/2's labels are optimal, 87% of adapt/1's"


def test_a_threshold_of_0_turns_an_alert_off():
    alerts = Alerts(AlertsConfig(collapse=0, zero_episodes=0, silent_s=0, ingest=0, labels=0))
    for trial in range(50):
        alerts.add_return((0, 0, trial), 0, 5.0)
        alerts.add_return((0, 0, trial), 1, 0.0)
        alerts.add_waiting(float(trial), {"w0": float(trial)})
    alerts.add_label_quality(0, 1.0)
    alerts.add_label_quality(1, 0.0)
    assert changes(alerts, {"w0": 1e9}) == []


def test_zero_returns_of_one_phase_do_not_count_in_the_next():
    alerts = Alerts(AlertsConfig(zero_episodes=3))
    for trial in range(2):
        alerts.add_return((0, 0, trial), -1, 0.0)
    alerts.begin_phase()
    alerts.add_return((0, 0, 0), 0, 0.0)
    assert changes(alerts) == []


def test_thresholds_are_read_from_the_run_file():
    assert parse("[alerts]\ncollapse = 0.25", "x").alerts.collapse == 0.25
    assert load("demo").alerts == AlertsConfig()
    for line, what in (
        ("collapse = 2.0", "alerts.collapse = 2.0"),
        ("silent_s = -1.0", "alerts.silent_s"),
        ("ingest = nan", "ingest"),
    ):
        with pytest.raises(ConfigError, match=what):
            parse(f"[alerts]\n{line}", "x")
