"""The Desk over a MemoryLink: what workers are told, and what is known of those that went wrong."""

import dataclasses
import json
import threading
import time

import pytest

import icrl_dist
from icrl_dist import version
from icrl_dist.config.run import parse
from icrl_dist.methods.recipes import METHODS
from icrl_dist.stream import wire
from icrl_dist.stream.link import Refused, StreamKeys
from icrl_dist.telemetry import crash_reports
from learner import worker_api as desk_module
from learner.scheduler import Board
from learner.worker_api import Desk

KEYS = StreamKeys("test")
COUNTS = {"episodes": 0, "steps": 0, "resent": 0, "trajectories": 0, "waited_s": 0.0}
RECORD = {"what": "raised", "job": "pretrain/0/0", "exception": "ValueError: no (room.py:3)"}


class Office:
    """A Desk with a Board of three jobs, what it reports, and workers to send there."""

    def __init__(self, run, folder, hub, monkeypatch):
        monkeypatch.setattr(desk_module, "_MOMENT_S", 0.0)
        self.run, self.folder, self.events, self.failures = run, folder, [], []
        self.jobs = METHODS["icag"].ask(run, METHODS["icag"].phases(run)[0])[:3]
        self.board = Board(60.0)
        self.board.open(self.jobs, lambda job: ())
        self.acting = None
        link = hub()
        lock = threading.Lock()
        act = lambda job: self.acting if self.acting is not None else job.policy_version  # noqa: E731
        self.desk = Desk(run, folder, link, KEYS, self.board, lock, self.events.append, self.failures.append, act)
        self.link = hub()

    def say(self, kind, worker, link=None, **fields):
        message = wire.encode_message(kind, worker=worker, **fields)
        return wire.decode_message((link or self.link).request(KEYS.work, message, timeout_s=10.0))

    def ask(self, worker, **counts):
        return self.say("ask", worker, **{**COUNTS, **counts})

    def fail(self, worker, job, file="", **record):
        return self.say("failed", worker, job=list(job.name), file=file, record={**RECORD, "worker": worker, **record})

    def wait(self, kind, count=1):
        """The events of this kind, once there are so many."""
        deadline = time.monotonic() + 30
        while len(found := [e for e in list(self.events) if e["event"] == kind]) < count:
            assert time.monotonic() < deadline, f"{count} events {kind!r} did not come: {self.events}"
            time.sleep(0.01)
        return found


@pytest.fixture
def office(small_run, tmp_path, hub, monkeypatch):
    office = Office(small_run, tmp_path, hub, monkeypatch)
    yield office
    office.desk.close()


@pytest.fixture
def worker(hub, office):
    """``worker(name)``: announced, with a link of its own to close."""

    def announced(name):
        link, before = hub(), sum(e["event"] == "worker" for e in office.events)
        link.announce(KEYS.alive(name))
        office.wait("worker", before + 1)
        return link

    return announced


def records(office):
    return {path.name: json.loads(path.read_text()) for path in (office.folder / "crashes").glob("*.json")}


def test_hello_gives_the_run_and_refuses_another_version(office):
    _, fields = office.say("hello", "w0", version=icrl_dist.__version__, code=version.digest(), pid=1)
    assert parse(fields["run"], "test") == office.run
    with pytest.raises(Refused, match=r"w0 runs icrl-dist 0\.0, the learner"):
        office.say("hello", "w0", version="0.0", code=version.digest(), pid=1)
    with pytest.raises(Refused, match="runs icrl-dist's code ffffffff, the learner"):
        office.say("hello", "w0", version=icrl_dist.__version__, code="f" * 64, pid=1)


def test_nonsense_is_refused_and_the_next_question_answered(office):
    for kind, fields in (("dance", {}), ("ask", {}), ("ask", {**COUNTS, "steps": "x"}), ("failed", {"job": [1]})):
        with pytest.raises(Refused, match="schema"):
            office.say(kind, "w0", **fields)
    with pytest.raises(Refused, match="schema"):
        office.link.request(KEYS.work, b"\xc1", timeout_s=10.0)
    assert office.ask("w0")[0] == "job"


def test_who_asks_gets_a_job_with_its_deadline_then_wait_then_stop(office):
    for i, job in enumerate(office.jobs):
        kind, fields = office.ask(f"w{i}")
        assert (kind, wire.decode_job(fields["job"]), fields["deadline_s"]) == ("job", job, 60.0)
    assert office.ask("w3") == ("wait", {"seconds": 0.1})
    office.desk.finish()
    assert office.ask("w3") == ("stop", {})


def test_the_service_says_which_weights_a_job_acts_with(office):
    office.acting = 5
    assert wire.decode_job(office.ask("w0")[1]["job"]).policy_version == 5
    assert office.board.wants(next(iter(office.jobs[0].identities()))).policy_version == 5


def test_counters_are_the_newest_of_every_worker_and_never_fall(office, hub):
    office.ask("w0", episodes=3, steps=24, resent=2, trajectories=3, waited_s=1.5)
    office.ask("w1", resent=1)
    heartbeat = {**COUNTS, "episodes": 2, "resent": 1, "memory_mb": 80.5, "job": "pretrain/0/0"}
    beating = hub()
    beating.publish(KEYS.monitor("worker/w0"), wire.encode_message("worker", worker="w0", **heartbeat), droppable=True)
    deadline = time.monotonic() + 30
    while "memory_mb" not in office.desk.counters["w0"]:
        assert time.monotonic() < deadline, "the heartbeat was not heard"
        time.sleep(0.01)
    said = office.desk.counters["w0"]
    assert [said[name] for name in COUNTS] == [3, 24, 2, 3, 1.5] and said["memory_mb"] == 80.5
    assert office.desk.resent == 3 and office.desk.told["waited_s"] == 1.5


def test_nobody_waits_for_a_worker_whose_next_life_has_come(office, worker):
    link = worker("w0")
    office.ask("w0")
    link.close()
    office.wait("worker", 2)
    assert "w0" in office.desk.told["silent"]
    worker("w0-1")
    assert "w0" not in office.desk.told["silent"]


def test_a_worker_that_vanishes_leaves_a_record_of_what_it_did_last(office, worker):
    link = worker("w0")
    office.ask("w0", episodes=7)
    link.close()
    (event,) = office.wait("crash")
    assert event["text"] == f"worker w0 vanished (without a word); {office.folder / 'crashes' / 'w0-1.json'}"
    (record,) = records(office).values()
    assert (record["what"], record["job"], record["seed"]) == ("vanished", office.jobs[0].label, office.run.seed)
    assert record["last_said"]["episodes"] == 7 and record["stacks"] == []
    joined, gone = (event["text"] for event in office.wait("worker", 2))
    assert joined == "worker w0 joined" and gone == "worker w0 is gone; its job goes to another: pretrain/0/0"
    assert wire.decode_job(office.ask("w1")[1]["job"]) == office.jobs[0]


def test_the_record_of_a_stuck_worker_holds_its_stacks(office, worker):
    link = worker("w0")
    office.ask("w0")
    stacks = crash_reports.stacks_of(office.folder, "w0")
    stacks.parent.mkdir()
    stacks.write_text("Timeout (0:00:05)!\n  File x in step\n" + "deep\n" * 100)
    link.close()
    (event,) = office.wait("crash")
    assert "vanished (Timeout (0:00:05)!)" in event["text"]
    (record,) = records(office).values()
    assert record["stacks"][:2] == ["Timeout (0:00:05)!", "  File x in step"] and len(record["stacks"]) == 60


def test_a_worker_that_ends_with_the_run_leaves_nothing(office, worker):
    early, first, second = worker("w0"), worker("w1"), worker("w2")
    early.close()
    office.wait("crash")
    for name, text in (("w0", "Timeout (0:00:05)!"), ("w1", ""), ("w2", "")):
        crash_reports.stacks_of(office.folder, name).write_text(text)
    office.desk.finish()
    office.ask("w1")
    first.close()
    second.close()
    office.desk.dismiss(timeout_s=30.0)
    assert office.desk.workers == {"w0": False, "w1": False, "w2": False}
    assert sorted(path.name for path in (office.folder / "crashes").iterdir()) == ["w0-1.json", "w0.stacks"]


def test_a_worker_cut_off_and_back_is_not_dead_and_keeps_its_job(office, worker):
    for times in range(3):
        link = worker("w0")
        office.ask("w0")
        link.close()
        office.wait("worker", 2 * times + 2)
    worker("w0")
    assert office.wait("worker")[-1]["text"] == "worker w0 is back"
    assert wire.decode_job(office.ask("w1")[1]["job"]) == office.jobs[1], "w0 is at work on the first"


def test_a_job_that_raised_is_recorded_where_the_worker_could_not(office):
    office.ask("w0")
    office.fail("w0", office.jobs[0])
    (event,) = office.wait("crash")
    path = office.folder / "crashes" / "w0-1.json"
    assert event["text"] == f"worker w0: job pretrain/0/0 failed: ValueError: no (room.py:3); {path}"
    assert records(office) == {"w0-1.json": {**RECORD, "worker": "w0"}}


def test_a_record_that_the_worker_wrote_is_named_and_not_written_again(office):
    office.ask("w0")
    path = crash_reports.write(office.folder, {**RECORD, "worker": "w0"})
    office.fail("w0", office.jobs[0], file=path.name)
    assert office.wait("crash")[0]["text"].endswith(f"; {path}")
    office.fail("w0", office.jobs[0], file="../../elsewhere.json")
    assert office.wait("crash", 2)[1]["text"].endswith("w0-2.json")
    assert sorted(records(office)) == ["w0-1.json", "w0-2.json"]


def test_a_quarantine_is_told_once_and_the_run_goes_on(office):
    culprit = office.jobs[0].variations[4]
    while (answer := office.ask("w0"))[0] == "job":
        job = wire.decode_job(answer[1]["job"])
        if culprit in job.variations:
            office.fail("w0", job)
        else:
            for identity in job.identities():
                office.board.received(identity, 0.0)
    (event,) = office.wait("quarantine")
    assert (event["identity"], event["cause"]) == ("pretrain/0/1/1", "ValueError: no (room.py:3)")
    assert event["text"] == "variation pretrain/0/1/1 is quarantined, the run goes on without it: ValueError: no (room.py:3)"
    assert len(office.wait("crash", 3)) == 3 and not office.failures
    assert office.board.done("pretrain", 0) and office.board.progress("pretrain", 0) == (34, 34)
    assert office.board.blamed() == [("pretrain/0/1/1", "ValueError: no (room.py:3)")]


def test_the_cause_of_a_quarantine_by_death_says_who_and_where(office, worker):
    alone = dataclasses.replace(office.jobs[0], variations=office.jobs[0].variations[:1], tasks=1)
    office.board.open([alone], lambda job: ())
    for life in range(3):
        link = worker(f"w{life}")
        office.ask(f"w{life}")
        stacks = crash_reports.stacks_of(office.folder, f"w{life}")
        stacks.parent.mkdir(exist_ok=True)
        stacks.write_text("Fatal Python error: Segmentation fault\n")
        link.close()
        office.wait("crash", life + 1)
    assert office.wait("quarantine")[0]["cause"] == "worker w2 died: Fatal Python error: Segmentation fault"


def test_workers_that_went_with_their_machines_quarantine_nothing(office, worker):
    alone = dataclasses.replace(office.jobs[0], variations=office.jobs[0].variations[:1], tasks=1)
    office.board.open([alone], lambda job: ())
    keep = office.jobs[1]
    office.board.open([dataclasses.replace(keep, stage="adapt")], lambda job: ())
    office.desk.excuse(["w0"])
    for life in range(4):
        link = worker(f"w{life}")
        assert wire.decode_job(office.ask(f"w{life}")[1]["job"]) == alone
        link.close()
        office.wait("crash", life + 1)
    office.wait("quarantine")
    office.desk.excuse(["w1", "w2", "w3"])
    assert office.wait("released")[0]["text"].startswith("variation pretrain/0/0/0 is tried again")
    assert wire.decode_job(office.ask("w4")[1]["job"]) == alone and not office.board.quarantined


def test_a_run_in_which_everything_fails_ends_with_the_cause(office):
    while not office.failures:
        kind, fields = office.ask("w0")
        assert kind == "job"
        office.fail("w0", wire.decode_job(fields["job"]))
    (line,) = office.failures
    assert line.startswith("pretrain/0: not one trajectory was stored, and 8 of its variations are quarantined")
    assert line.endswith("first: ValueError: no (room.py:3)")


def test_a_phase_in_which_nothing_is_left_ends_the_run(office):
    alone = dataclasses.replace(office.jobs[0], variations=office.jobs[0].variations[:1], tasks=1)
    office.board.open([alone], lambda job: ())
    for _ in range(3):
        assert not office.failures
        office.ask("w0")
        office.fail("w0", alone)
    assert office.failures[0].startswith("pretrain/0: not one trajectory was stored, and 1 of")


def test_a_record_that_cannot_be_written_is_said_too(office):
    (office.folder / "crashes").write_text("a file is in the way")
    office.ask("w0")
    office.fail("w0", office.jobs[0])
    assert "its record cannot be written" in office.wait("crash")[0]["text"]


def test_what_takes_long_is_shown_while_its_worker_is_here_and_a_note_at_once(office, worker):
    assert office.desk.doing == []
    links = {name: worker(name) for name in ("w1", "w0")}
    for name, text in (("w0", "4 experts at 1,000 of 12,000 steps"), ("w1", "")):
        office.ask(name, doing=text)
    assert office.desk.doing == ["w0: 4 experts at 1,000 of 12,000 steps"]
    office.ask("w1", doing="x" * 1000)
    assert [len(text) for text in office.desk.doing] == [len("w0: 4 experts at 1,000 of 12,000 steps"), len("w1: ") + 100]
    links["w0"].close()
    office.wait("worker", 3)
    assert [text[:3] for text in office.desk.doing] == ["w1:"]
    assert office.say("note", "w1", text="2 experts from the cache")[0] == "noted"
    assert office.wait("note")[0]["text"] == "worker w1: 2 experts from the cache"
    with pytest.raises(Refused, match="expected hello, ask, failed or note"):
        office.say("gossip", "w1")
