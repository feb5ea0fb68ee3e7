"""What a user sees of a run: in terminals of several widths and kinds, and in a file."""

import io
import re

import pytest
from rich.console import Console

from icrl_dist.console import display
from icrl_dist.console.display import Display

COLLECT = {"event": "progress", "stage": "collect", "phase": "pretrain", "round": 0, "version": -1, "steps": 400}
COLLECT |= {"per_s": 237.0, "workers": 2, "lag": 0, "drops": {}, "doing": []}
LINE = r"\d{4}-\d\d-\d\dT\d\d:\d\d:\d\dZ "


class Clock:
    """In place of the module ``time`` of the display."""

    now = 0.0

    def monotonic(self):
        return self.now


@pytest.fixture
def clock(monkeypatch):
    clock = Clock()
    monkeypatch.setattr(display, "time", clock)
    return clock


def console(monkeypatch, width, terminal, **variables):
    for name in ("NO_COLOR", "TERM", "FORCE_COLOR"):
        monkeypatch.delenv(name, raising=False)
    for name, value in variables.items():
        monkeypatch.setenv(name, value)
    return Console(file=io.StringIO(), width=width, force_terminal=terminal, legacy_windows=False, soft_wrap=not terminal)


def run(console, clock, seconds, every=1.0, steps=400):
    with Display(console) as shown:
        clock.now += 0.1
        shown.report({"event": "note", "text": "worker w9 [bold]joined[/x] \x1b[2J late " + "x" * 300})
        for second in range(int(seconds / every) + 1):
            clock.now += every
            shown.report({**COLLECT, "steps": steps, "step": int(steps * second * every / seconds)})
        shown.report({**COLLECT, "steps": steps, "step": steps})
    return console.file.getvalue()


@pytest.mark.parametrize("width", [40, 80, 120, 200])
@pytest.mark.parametrize("variables", [{"TERM": "xterm-256color"}, {"TERM": "xterm", "NO_COLOR": "1"}])
def test_a_finished_stage_leaves_its_row_at_any_width(monkeypatch, clock, width, variables):
    output = run(console(monkeypatch, width, True, **variables), clock, 60)
    plain = re.sub(r"\x1b\[[0-9;?]*[A-Za-z]", "", output).replace("\r", "\n")
    rows = [line.rstrip() for line in plain.splitlines() if line.startswith("pretrain/0")]
    assert rows and all(len(row) <= width for row in rows) and re.search(r"█+ 100% 1:00", rows[-1])
    assert "\x1b[2J" not in output and "[bold]joined[/x]" in plain, "text of a run is neither markup nor escape codes"


@pytest.mark.parametrize(("terminal", "variables"), [(False, {}), (True, {"TERM": "dumb"})])
def test_without_a_terminal_every_line_has_the_time_and_progress_is_rare(monkeypatch, clock, terminal, variables):
    lines = run(console(monkeypatch, 80, terminal, **variables), clock, 3600).splitlines()
    if not terminal:
        assert all(re.match(LINE, line) for line in lines)
    rows = [line for line in lines if "pretrain/0: contexts, D^0" in line]
    assert 30 <= len(rows) <= 130 and "100%" in rows[-1] and "100%" not in rows[-2]
    assert re.search(
        r"contexts, D\^0 +50%  (29|30|31):\d\d left +2\d\d/400, 237/s 2 workers$", rows[len(rows) * 3 // 4]
    ) or any(re.search(r"50%  (29|30|31):\d\d left", row) for row in rows)


def test_a_run_of_a_week_prints_a_line_every_ten_minutes(monkeypatch, clock):
    lines = run(console(monkeypatch, 80, False), clock, 7 * 86400, every=60.0, steps=10**6).splitlines()
    assert 900 < len(lines) < 1100


def test_a_stage_that_ends_is_printed_once(monkeypatch, clock):
    shown_on = console(monkeypatch, 80, False)
    with Display(shown_on) as shown:
        for step in (0, 400, 400, 400):
            shown.report({**COLLECT, "step": step})
        for step in (1, 10):
            shown.report({**COLLECT, "stage": "fit", "step": step, "steps": 10, "loss": 1.0})
        shown.report({**COLLECT, "step": 10, "steps": 400})  # collected again, after a repair
    rows = re.findall(r"pretrain/0: (\w+).* (\d+)%", shown_on.file.getvalue())
    collect, fit = "contexts", "fit"
    assert rows == [(collect, "0"), (collect, "100"), (fit, "10"), (fit, "100"), (collect, "2"), (collect, "2")]


def test_between_two_stages_a_terminal_says_what_it_waits_for(monkeypatch, clock):
    shown = Display(console(monkeypatch, 80, True))
    clock.now = 5.0
    assert shown._draw().plain == "starting, 0:05"
    shown.report({**COLLECT, "step": 400})
    assert shown._draw().plain == ""
    clock.now = 15.0
    assert shown._draw().plain == "waits for the next stage, 0:10"
