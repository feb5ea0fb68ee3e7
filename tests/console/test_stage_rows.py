"""The row of a stage at any width, the time that is left, and what a run waits for."""

import math

import pytest
from rich.cells import cell_len

from icrl_dist.console.stage_rows import Pace, StageRow, duration, fitted

COLLECT = {"event": "progress", "stage": "collect", "phase": "adapt", "round": 0, "version": 0, "step": 0, "steps": 400}
COLLECT |= {"per_s": 237.0, "workers": 2, "lag": 0, "drops": {}, "doing": []}
FIT = {**COLLECT, "stage": "fit", "round": 11, "version": 11, "loss": 1.25}
EVALUATE = {"event": "progress", "stage": "evaluate", "phase": "評価" * 20, "step": 0, "steps": 400}


def row(event, step, seconds, still=0.0):
    """The row of a stage that reached ``step`` after ``seconds`` and has stood still since; and the present time."""
    made = StageRow(event, 0.0)
    for second in range(int(seconds) + 1):
        made.update({**event, "step": int(step * second / seconds)}, float(second))
    return made, seconds + still


@pytest.mark.parametrize("event", [COLLECT, {**COLLECT, "doing": ["w0: trains experts 3/8, 20:00"] * 9}, FIT, EVALUATE])
@pytest.mark.parametrize("width", [30, 40, 60, 80, 120, 200])
@pytest.mark.parametrize("ascii_only", [False, True])
def test_bar_percent_and_time_left_are_kept_at_every_width(event, width, ascii_only):
    made, now = row(event, 100, 20 * 3600)
    text = made.fit(width, now, ascii_only)
    assert cell_len(text) <= width and " 25% 2d 12h left" in text
    assert ("#" if ascii_only else "█") in text or width < 40
    assert ("100/400" in text) == (width >= 80)


def test_a_sweep_shows_the_text_of_its_event_and_its_time_left():
    event = {"event": "progress", "stage": "sweep", "phase": "sweep", "step": 0, "steps": 400, "text": "1/4 runs; a/b/0 fit"}
    made, now = row(event, 100, 60)
    assert made.name == "sweep" and made.text(now + 80) == "1/4 runs; a/b/0 fit" and made.time(now) == "3:00 left"


def test_a_row_says_what_it_counts_and_waits_for():
    made, now = row(COLLECT, 100, 50)
    assert made.text(now) == "100/400 237/s 2 workers"
    assert made.text(now + 80) == "learner silent 1:20"
    for second in range(51, 131):
        made.update({**COLLECT, "step": 100}, float(second))
    assert made.text(130.0) == "nothing for 1:20: waits for trajectories of 2 workers"
    made.update({**COLLECT, "step": 100, "workers": 0}, 131.0)
    assert made.text(131.0) == "waits for a worker"
    made.update({**COLLECT, "step": 100, "doing": ["w0: trains an expert"]}, 132.0)
    assert made.text(132.0) == "100/400, 2 workers; w0: trains an expert"
    fit, now = row(FIT, 10, 20, still=30.0)
    assert fit.text(now) == "no step for 0:30" and fit.name == "adapt/11: fit T^12"


def test_a_finished_stage_says_how_long_it_took():
    made, now = row(COLLECT, 400, 3700, still=99.0)
    assert made.finished and made.percent() == "100%" and made.time(now) == "1:01:40"
    made, now = row(COLLECT, 399, 100)
    assert made.percent() == "99%", "100% only at the end"


@pytest.mark.parametrize(
    ("seconds", "text"),
    [
        *((0, "0:00"), (59.6, "1:00"), (3599, "59:59"), (3600, "1:00:00"), (86399, "23:59:59"), (86400, "1d 00h")),
        *((40 * 86400 + 7300, "40d 02h"), (1e12, ">999d"), (math.inf, ">999d"), (-5, "0:00")),
    ],
)
def test_durations(seconds, text):
    assert duration(seconds) == text and len(text) <= 8


def test_the_time_left_counts_only_steps_of_this_session():
    pace = Pace(0.0, 900)
    assert pace.left(10.0, 1000) == math.inf
    for second in range(1, 11):
        pace.add(float(second), 900 + second)
    assert pace.left(10.0, 1000) == pytest.approx(90.0)


def test_the_time_left_follows_the_present_rate_and_grows_while_nothing_moves():
    pace = Pace(0.0, 0)
    for second in range(1, 1001):
        pace.add(float(second), second if second <= 500 else 500 + 10 * (second - 500))
    assert pace.left(1000.0, 6500) == pytest.approx(100.0, rel=0.2)
    assert pace.left(1200.0, 6500) > 130.0
    for step in range(100_000):
        pace.add(1000.0 + step, 6000 + step)
    assert len(pace._samples) <= 257


def test_wide_characters_are_cut_by_their_width():
    assert (
        fitted("評価評価", 5) == "評価…"
        and cell_len(fitted("評価評価", 6)) == 6
        and fitted("ab", 4) == "ab  "
        and fitted("ab", 0) == ""
    )
