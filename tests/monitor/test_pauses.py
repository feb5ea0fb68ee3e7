"""A replay shows the time in which a run ran, and nothing of the time between."""

import json

import pytest

from icrl_dist.monitor.pauses import MAX_GAP_S, PAUSE_S, without_pauses
from icrl_dist.monitor.recording import Recording
from icrl_dist.telemetry.metric_rows import NAME, read
from tests.monitor.fake_feed import BEGAN, run_folder


def times(rows, starts=()):
    return [row["time"] for row in without_pauses([{"time": float(time)} for time in rows], starts)]


@pytest.mark.parametrize(
    ("rows", "starts", "expected"),
    [
        ([], [0.0], []),
        ([10, 11, 14], [10.0], [10, 11, 14]),
        ([10, 11, 40_000, 40_002], [9.0, 39_990.0], [10, 11, 11 + PAUSE_S, 13 + PAUSE_S]),
        ([10, 11, 300], [9.0], [10, 11, 300]),  # a slow fit is no pause
        ([10, 11, 90_000], [9.0], [10, 11, 11 + MAX_GAP_S]),  # a suspended machine, or a clock set forward
        ([10, 11, 10.9, 12], [9.0], [10, 11, 11, 12]),  # an event is written late
        ([5000, 5001, 100, 103], [4999.0], [5000, 5001, 5001, 5004]),  # a clock set back
        ([10, 11, 11.4, 12], [9.0, 11.0], [10, 11, 11.4, 12]),  # a learner that was restarted at once
    ],
)
def test_times_of_a_replay(rows, starts, expected):
    assert times(rows, starts) == pytest.approx(expected)


def test_a_night_between_two_sessions_is_not_in_the_replay(tmp_path):
    folder = run_folder(tmp_path / "demo")
    night = 40_000.0
    rows = [{**row, "time": row["time"] + night * (row["time"] > BEGAN + 7)} for row in read(folder)]
    (folder / NAME).write_text("".join(json.dumps(row) + "\n" for row in rows[3:]))
    (folder / f"{NAME}.1").write_text("".join(json.dumps(row) + "\n" for row in rows[:3]))
    sessions = [{"began": "2026-01-01T00:00:00+00:00"}, {"began": "2026-01-01T11:06:46+00:00"}]
    from datetime import UTC, datetime

    for session, at in zip(sessions, (BEGAN - 1, BEGAN + 7 + night), strict=True):
        session["began"] = datetime.fromtimestamp(at, UTC).isoformat(timespec="seconds")
    (folder / "env.json").write_text(json.dumps({"sessions": sessions}))
    recording = Recording(folder)
    shown = [now for now, _, _ in recording.messages()]
    recording.close()
    assert recording.end - recording.begin < 12 and shown == sorted(shown)
