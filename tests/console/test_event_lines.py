"""One line for a death, whoever reports it and in whatever order; few lines for many workers."""

import itertools

import pytest

from icrl_dist.console.event_lines import EventLines

GONE = {"event": "worker", "worker": "w0", "alive": False, "text": "worker w0 is gone; its job will be leased again: adapt/0/3"}
CRASH = {"event": "crash", "worker": "w0", "text": "worker w0 ended without a report (no stacks); runs/demo/crashes/w0-1.json"}
DIED = {"event": "note", "text": "worker w0 died (exit code -9); starting it again"}
SILENT = {"event": "alert", "text": "ALERT: worker w0 has been silent for 5 s"}
ORDERS = [order for order in itertools.permutations([GONE, CRASH, DIED]) if order.index(GONE) < order.index(CRASH)]
"""The learner writes a crash record after it has noticed the end; Ray notices it by itself."""


def joined(worker):
    return {
        "event": "worker",
        "worker": worker,
        "alive": True,
        "text": f"worker {worker} {'is back' if worker == 'x' else 'joined'}",
    }


def shown(*events, seconds=0.1, end=True):
    """The lines of these events, ``seconds`` apart."""
    lines, found, now = EventLines(), [], 0.0
    for event in events:
        found += lines.add(event, now)
        now += seconds
    return found + (lines.due(now + 10.0) if end else [])


@pytest.mark.parametrize("order", ORDERS)
@pytest.mark.parametrize("seconds", [0.1, 5.0])
def test_a_death_is_one_line(order, seconds):
    lines = shown(*order, SILENT, joined("w0-1"), seconds=seconds)
    assert len(lines) == 1 and ("w0 died (exit code -9)" in lines[0] or "w0 ended" in lines[0] or "w0 is gone" in lines[0])
    if seconds == 0.1:
        assert lines == [f"{DIED['text']}; its job will be leased again: adapt/0/3; runs/demo/crashes/w0-1.json"]


def test_each_of_two_deaths_has_its_line():
    second = [{**GONE, "worker": "w0-1", "text": "worker w0-1 is gone"}, {**CRASH, "worker": "w0-1"}, DIED]
    for events in [second, [second[0], second[2], second[1]], [second[2], *second[:2]]]:
        assert len(shown(GONE, CRASH, DIED, joined("w0-1"), *events, joined("w0-2"))) == 2


def test_a_worker_that_was_disconnected_for_a_moment_is_no_line_and_for_longer_two():
    assert shown(joined("w0"), seconds=2.0) == ["worker w0 joined"]
    assert shown(GONE, {**joined("w0"), "text": "worker w0 is back"}) == []
    assert shown(GONE, SILENT, {**joined("w0"), "text": "worker w0 is back"}, seconds=5.0) == [
        GONE["text"],
        "worker w0 is back",
    ]


def test_a_restart_of_the_learner_is_one_line():
    listening = {"event": "listening", "host": "vm", "device": "cpu", "endpoint": "tcp/127.0.0.1:7", "version": -1}
    died = {"event": "note", "text": "the learner died (exit code -9); restarting it from its checkpoint"}
    start = [listening, joined("w0"), joined("w1")]
    again = [died, {**listening, "version": 0}, joined("w0"), joined("w1")]
    assert len(shown(*start)) == 2 and shown(*start, *again) == [*shown(listening), died["text"], "2 workers joined: w0, w1"]


def test_many_workers_that_come_and_go_are_few_lines():
    names = [f"w{number}" for number in range(500)]
    assert shown(*map(joined, names), seconds=0.001) == ["500 workers joined: w0, w1, w2 and 497 more"]
    gone = [{**GONE, "worker": name, "text": f"worker {name} is gone"} for name in names]
    assert shown(*gone, seconds=0.001) == ["500 workers are gone: w0, w1, w2 and 497 more; their jobs will be leased again"]


def test_an_error_in_a_job_of_a_worker_that_runs_on_is_a_line():
    raised = {"event": "crash", "worker": "w1", "text": "job adapt/0/3: ValueError: no; runs/demo/crashes/w1-1.json"}
    assert shown(GONE, CRASH, DIED, raised)[-1] == raised["text"]


def test_what_is_gathered_is_printed_at_the_end():
    lines = EventLines()
    lines.add(joined("w1"), 0.0)
    lines.add(GONE, 0.1)
    assert lines.rest() == ["worker w1 joined", GONE["text"]] and lines.rest() == []
