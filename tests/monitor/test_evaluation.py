"""What views say a run is worth: held-out returns, the words of the comparison, the evaluating state, the sentence on top."""

import time

import numpy as np
import pytest

from icrl_dist.console.phase_names import round_text, stage_text
from icrl_dist.monitor import evaluation
from icrl_dist.monitor.feed import LiveFeed, ReplayFeed
from icrl_dist.monitor.headline import headline
from icrl_dist.monitor.run_state import RunState
from icrl_dist.results import rows
from icrl_dist.storage import files
from tests.monitor.fake_feed import FakeFeed, run_folder
from tests.monitor.messages import event, progress, run_info, send
from tests.monitor.terminal import drive, text
from tests.results.row_blocks import block, frame

NOISE = np.random.default_rng(0).normal(size=(6, 4, 8))
RUN = {"state": "collecting", "phase": "adapt", "round": 1, "rounds": 2, "stage": "collect", "version": 1, "eta_s": 360.0}
WORKING = [{"state": "working"}]


def evaluated(gain, **others):
    """Held-out returns of T^2, T^0, a random policy and an oracle; T^2 earns ``gain`` more than T^0."""
    agents = [block(6 + gain + NOISE, "t2", **others), block(6 - NOISE, "t0", **others), block(1 + NOISE, "random", **others)]
    return [*agents, block(9 + 0 * NOISE, "oracle", ceiling=True, **others), block(5 + NOISE, "exact", **others)]


@pytest.mark.parametrize(
    ("gain", "verdict", "words"),
    [
        (3.0, "higher", "a gain, in this training"),
        (-3.0, "lower", "a loss, in this training"),
        (0.0, "not shown", "a gain is not"),
    ],
)
def test_held_out_returns_are_compared_with_t0_in_the_words_of_the_results(gain, verdict, words):
    found = evaluation.of_rows(frame(*evaluated(gain), *evaluated(gain, p=0.2)))
    assert found is not None and [level["p"] for level in found["levels"]] == [0.0, 0.2]
    level = found["levels"][1]
    assert level["verdict"] == verdict and level["gain"][1] < level["gain"][0] < level["gain"][2]
    assert [(agent["key"], agent["role"]) for agent in level["agents"]] == [
        ("t2", "newest"),
        ("t0", "model"),
        ("random", "reference"),
        ("oracle", "reference"),
    ]
    assert level["left_out"] == 1 and level["ceiling"] == "oracle" and len(level["agents"][0]["episodes"]) == 8
    share = level["agents"][0]["share"][0]
    assert share == pytest.approx((6 + gain) / 9, abs=0.1)
    line = headline(RUN, WORKING, 0, found)
    assert line.startswith("Round 2 of 2 (adapt/1), 6 min left, healthy; held-out (p = 0.2) T^2 ")
    assert f"{share:.2f} of oracle, T^0 " in line and words in line


def test_without_t0_or_with_t0_alone_nothing_is_compared():
    for blocks in ([block(6 + NOISE, "t2")], [block(6 + NOISE, "t0")]):
        found = evaluation.of_rows(frame(*blocks))
        assert found is not None and found["levels"][0]["verdict"] is None
        assert headline(RUN, WORKING, 0, found).endswith(f"{(6 + NOISE[..., -5:].mean()):.2f}.")


def test_the_sentence_names_trouble_and_states():
    def line(workers=WORKING, alerts=0, found=None, **changes):
        return headline(RUN | changes, workers, alerts, found)

    assert line() == "Round 2 of 2 (adapt/1), 6 min left, healthy; held-out returns follow after the training."
    assert ", 2 alerts and 1 worker gone or silent; " in line([{"state": "gone"}, *WORKING], 2)
    assert ", time left not known yet, nothing heard for 20 s; " in line(state="silent", silent_s=20.0, eta_s=None)
    assert line(state="waiting") == "Waiting for a learner."
    over = {"state": "evaluating", "elapsed_s": 7200.0, "eta_s": None}
    assert line(**over) == "Training finished after 2.0 h; the held-out evaluation is running."
    assert line(**over | {"state": "finished"}) == "Training finished after 2.0 h; no held-out returns yet."
    assert line(**over | {"state": "interrupted"}).startswith("Interrupted after 2.0 h, Round 2 of 2 (adapt/1); ")


def test_a_phase_has_one_name_everywhere():
    fit = RUN | {"stage": "fit"}
    assert (round_text(RUN), stage_text(RUN), stage_text(fit)) == (
        "Round 2 of 2 (adapt/1)",
        "adapt/1: rollouts of T^1",
        "adapt/1: fit T^2",
    )
    assert stage_text(fit | {"version": 2}) == "adapt/1: fit T^2", "also after the fit"
    first = RUN | {"phase": "pretrain", "round": 0, "version": -1}
    assert (round_text(first), stage_text(first)) == ("Pretraining (pretrain/0), 2 rounds follow", "pretrain/0: contexts, D^0")
    assert (round_text({}), stage_text({})) == ("", "")


def test_a_finished_training_is_evaluating_while_its_folder_is_held():
    state = RunState("demo")
    send(state, "run", run_info())
    send(state, "learner", progress())
    state.set_evaluation(None, True)
    assert state.snapshot(1.0)["run"]["state"] == "collecting"
    send(state, "event", event("finished", "done"))
    assert state.snapshot(1.0)["run"]["state"] == "evaluating" and "is running" in state.snapshot(1.0)["headline"]
    found = evaluation.of_rows(frame(*evaluated(0.0)))
    state.set_evaluation(found, False)
    shown = state.snapshot(1.0)
    assert shown["run"]["state"] == "finished" and shown["evaluation"] == found
    state.tick(2.0)
    assert state.snapshot(2.0, state.seq)["evaluation"] is None, "only when it has changed"
    state.clear()
    assert state.snapshot(2.0)["evaluation"] == found, "seeking in a recording keeps it"


def until(condition):
    deadline = time.monotonic() + 60
    while not condition():
        assert time.monotonic() < deadline
        time.sleep(0.05)


def test_feeds_read_the_evaluation_from_the_folder(tmp_path, hub, monkeypatch):
    monkeypatch.setattr(evaluation, "_PERIOD_S", 0.05)
    folder = run_folder(tmp_path / "demo")
    with files.hold(folder), ReplayFeed(folder) as replay, LiveFeed(hub(), "demo", folder) as live:
        assert replay.now() > 1_700_000_008.0, "a run that is evaluated now is shown at its end"
        until(lambda: replay.state.snapshot(0.0)["run"]["state"] == "evaluating")
        send(live.state, "learner", progress())
        send(live.state, "event", event("finished", "done"))
        until(lambda: live.state.snapshot(0.0)["run"]["state"] == "evaluating")
        rows.append(folder / "results", "online", {}, evaluated(0.0))
        for feed in (replay, live):
            until(lambda feed=feed: feed.state.snapshot(0.0)["evaluation"])
    with ReplayFeed(folder) as later:
        until(lambda: later.state.snapshot(0.0)["evaluation"])
        assert later.state.snapshot(0.0)["run"]["state"] != "evaluating"


def test_rows_that_cannot_be_shown_together_leave_the_card_empty(tmp_path, caplog):
    folder = run_folder(tmp_path / "demo")
    rows.append(folder / "results", "online", {}, [block(NOISE, "t0"), block(NOISE[:3], "t1", p=0.0)])
    state = RunState("demo")
    reader = evaluation.EvaluationReader(folder, state)
    until(lambda: "held-out returns are not shown" in caplog.text)
    reader.close()
    assert state.snapshot(0.0)["evaluation"] is None


def test_the_terminal_shows_training_and_held_out_returns_apart():
    feed = FakeFeed()
    feed.send_run_in_progress()
    feed.state.set_evaluation(evaluation.of_rows(frame(*evaluated(0.0), *evaluated(0.0, p=0.2))), False)
    feed.send("event", what="alert", alert="zero", active=True, text="no returns")

    async def wide(app, press):
        header = text(app, "header")
        for part in (
            "collecting, 1 alert",
            "Round 1 of 1 (adapt/0)",
            "training returns  adapt/0",
            "n 8 of 8",
            "ALERT no returns",
        ):
            assert part in header
        for part in ("held-out of oracle, p 0.2", "held-out of oracle, p 0 ", "T^0 0.6", "random 0.1", "oracle 1.00"):
            assert part in header

    async def narrow(app, press):
        header = text(app, "header")
        assert "p 0.2" in header and "p 0 " not in header and max(map(len, header.splitlines())) <= 80

    drive(feed, wide, (140, 45))
    drive(feed, narrow, (80, 24))
