"""The worker API on a MemoryLink: its answers to workers, and its records of their failures."""

import dataclasses
import json
import threading
import time
from typing import Any

import pytest

import icrl_dist
from icrl_dist import version
from icrl_dist.config import plugins
from icrl_dist.config.run import make_run, parse
from icrl_dist.stream import messages, wire
from icrl_dist.stream.link import Refused, StreamKeys
from icrl_dist.stream.validation import read
from icrl_dist.telemetry import crash_reports
from learner import worker_api as worker_api_module
from learner.scheduler import LeaseScheduler
from learner.worker_api import WorkerAPI
from tests.jobs import decoded, jobs_of
from tests.toys.site import CORRIDOR, SLIPPERY, installed

KEYS = StreamKeys("test")
COUNTS = {"episodes": 0, "steps": 0, "resent": 0, "trajectories": 0, "waited_s": 0.0}
RECORD = {"what": "raised", "job": "pretrain/0/0", "exception": "ValueError: no (room.py:3)"}


class Server:
    """A WorkerAPI with a LeaseScheduler of three jobs, its events, and requests of workers to it."""

    def __init__(self, run, folder, hub, monkeypatch):
        monkeypatch.setattr(worker_api_module, "_STACKS_DELAY_S", 0.0)
        self.run, self.folder = run, folder
        self.events: list[dict[str, Any]] = []
        self.failures: list[str] = []
        self.jobs = jobs_of(run, "icag")[:3]
        self.scheduler = LeaseScheduler(60.0)
        self.scheduler.open(self.jobs, lambda job: ())
        self.policy_version = None
        link = hub()
        lock = threading.Lock()

        def policy_version(job):
            return self.policy_version if self.policy_version is not None else job.policy_version

        arguments = link, KEYS, self.scheduler, lock, self.events.append, self.failures.append, policy_version
        self.worker_api = WorkerAPI(run, folder, *arguments)
        self.link = hub()

    def request(self, kind, worker, link=None, **fields):
        message = wire.encode_message(kind, worker=worker, **fields)
        return wire.decode_message((link or self.link).request(KEYS.work, message, timeout_s=10.0))

    def hello(self, worker, **changed):
        fields = {"version": icrl_dist.__version__, "code": version.digest(), "plugins": {}, "pid": 1}
        return self.request("hello", worker, **{**fields, **changed})

    def ask(self, worker, **counts):
        return self.request("ask", worker, **{**COUNTS, **counts})

    def fail(self, worker, job, file="", ends_run="", **record):
        fields = {"job": list(job.name), "file": file, "ends_run": ends_run, "record": {**RECORD, "worker": worker, **record}}
        return self.request("failed", worker, **fields)

    def wait(self, kind, count=1):
        """Wait for ``count`` events of this kind; returns them."""
        deadline = time.monotonic() + 30
        while len(found := [e for e in list(self.events) if e["event"] == kind]) < count:
            assert time.monotonic() < deadline, f"{count} events {kind!r} did not arrive: {self.events}"
            time.sleep(0.01)
        return found


@pytest.fixture
def server(small_run, tmp_path, hub, monkeypatch):
    server = Server(small_run, tmp_path, hub, monkeypatch)
    yield server
    server.worker_api.close()


@pytest.fixture
def worker(hub, server):
    """``worker(name)``: announces a worker and returns its own link, to be closed."""

    def announced(name):
        link, before = hub(), sum(e["event"] == "worker" for e in server.events)
        link.announce(KEYS.alive(name))
        server.wait("worker", before + 1)
        return link

    return announced


def records(server):
    return {path.name: json.loads(path.read_text()) for path in (server.folder / "crashes").glob("*.json")}


def test_hello_returns_the_run_and_refuses_another_version(server):
    _, fields = server.hello("w0")
    assert parse(fields["run"], "test") == server.run
    with pytest.raises(Refused, match=r"w0 runs icrl-dist 0\.0, the learner"):
        server.hello("w0", version="0.0")
    with pytest.raises(Refused, match="runs icrl-dist's code ffffffff, the learner"):
        server.hello("w0", code="f" * 64)


def sources(site, text, number="1.0"):
    """What a worker says about its other packages where this source of the problem ``toy`` is installed."""
    with installed(site, {"toy_problem.py": text}, number=number):
        return {name: list(source) for name, source in plugins.sources().items()}


def test_a_worker_with_another_source_of_the_runs_problem_is_refused(server, tmp_path, monkeypatch):
    same = sources(tmp_path / "same", CORRIDOR)
    other, newer = sources(tmp_path / "other", SLIPPERY), sources(tmp_path / "newer", CORRIDOR, "1.1")
    with installed(tmp_path / "learner", {"toy_problem.py": CORRIDOR}):
        without_plugins = dict[str, Any]()
        for plugins_there in (same, other, without_plugins):
            server.hello("w0", plugins=plugins_there)  # the run has another problem
        monkeypatch.setattr(server.worker_api, "_run", make_run("toy"))
        server.hello("w0", plugins=same)
        codes = {name: made["problems/toy"][2][:8] for name, made in (("same", same), ("other", other))}
        ours = rf"the learner has toys 1\.0 with code {codes['same']}: install the same version on every node"
        for there, theirs in (
            (other, rf"toys 1\.0 with code {codes['other']}"),
            (newer, rf"toys 1\.1 with code {codes['same']}"),
            ({}, "no other package with it"),
        ):
            with pytest.raises(Refused, match=f"problem 'toy': worker w0 has {theirs}, {ours}"):
                server.hello("w0", plugins=there)
    monkeypatch.setattr(server.worker_api, "_run", server.run)
    with pytest.raises(Refused, match=r"method 'icaa': worker w0 has toys .*, the learner has no other package with it"):
        server.hello("w0", plugins={"methods/icaa": same["problems/toy"]})


def test_invalid_requests_are_refused_and_the_next_is_answered(server):
    for kind, fields in (("unknown", {}), ("ask", {}), ("ask", {**COUNTS, "steps": "x"}), ("failed", {"job": [1]})):
        with pytest.raises(Refused, match="schema"):
            server.request(kind, "w0", **fields)
    with pytest.raises(Refused, match="schema"):
        server.link.request(KEYS.work, b"\xc1", timeout_s=10.0)
    assert server.ask("w0")[0] == "job"


def test_requests_are_answered_with_jobs_then_wait_then_stop(server):
    for i, job in enumerate(server.jobs):
        kind, fields = server.ask(f"w{i}")
        assert (kind, decoded(server.run, fields["job"]), fields["deadline_s"]) == ("job", job, 60.0)
        assert read(messages.LeasedJob, fields, kind).name == job.name
    assert server.ask("w3") == ("wait", {"seconds": 0.1})
    server.worker_api.finish()
    assert server.ask("w3") == ("stop", {})


def test_a_job_gets_the_policy_version_of_the_service(server):
    server.policy_version = 5
    assert decoded(server.run, server.ask("w0")[1]["job"]).policy_version == 5
    assert server.scheduler.pending_job(next(iter(server.jobs[0].identities()))).policy_version == 5


def test_counters_are_the_newest_of_each_worker_and_never_decrease(server, hub):
    server.ask("w0", episodes=3, steps=24, resent=2, trajectories=3, waited_s=1.5)
    server.ask("w1", resent=1)
    heartbeat = {**COUNTS, "episodes": 2, "resent": 1, "memory_mb": 80.5, "job": "pretrain/0/0"}
    other = hub()
    other.publish(KEYS.monitor("worker/w0"), wire.encode_message("worker", worker="w0", **heartbeat), droppable=True)
    deadline = time.monotonic() + 30
    while "memory_mb" not in server.worker_api.known.counters["w0"]:
        assert time.monotonic() < deadline, "the heartbeat did not arrive"
        time.sleep(0.01)
    counters = server.worker_api.known.counters["w0"]
    assert [counters[name] for name in COUNTS] == [3, 24, 2, 3, 1.5] and counters["memory_mb"] == 80.5
    assert server.worker_api.known.resent == 3 and server.worker_api.known.totals["waited_s"] == 1.5


def test_the_silence_of_a_replaced_worker_is_no_alert(server, worker):
    link = worker("w0")
    server.ask("w0")
    link.close()
    server.wait("worker", 2)
    assert "w0" in server.worker_api.known.totals["silent"]
    worker("w0-1")
    assert "w0" not in server.worker_api.known.totals["silent"]


def test_a_worker_that_ends_without_a_report_gets_a_crash_record(server, worker):
    link = worker("w0")
    server.ask("w0", episodes=7)
    link.close()
    (event,) = server.wait("crash")
    cause, path = "no stacks were written: it was killed or disconnected", server.folder / "crashes" / "w0-1.json"
    assert event["text"] == f"worker w0 ended without a report ({cause}); {path}"
    (record,) = records(server).values()
    assert (record["what"], record["job"], record["seed"]) == ("vanished", server.jobs[0].label, server.run.seed)
    assert record["last_heartbeat"]["episodes"] == 7 and record["stacks"] == []
    joined, ended = (event["text"] for event in server.wait("worker", 2))
    assert joined == "worker w0 joined" and ended == "worker w0 is gone; its job will be leased again: pretrain/0/0"
    assert decoded(server.run, server.ask("w1")[1]["job"]) == server.jobs[0]


def test_the_record_of_a_stuck_worker_contains_its_stacks(server, worker):
    link = worker("w0")
    server.ask("w0")
    stacks = crash_reports.stacks_of(server.folder, "w0")
    stacks.parent.mkdir()
    stacks.write_text("Timeout (0:00:05)!\n  File x in step\n" + "deep\n" * 100)
    link.close()
    (event,) = server.wait("crash")
    assert "ended without a report (Timeout (0:00:05)!)" in event["text"]
    (record,) = records(server).values()
    assert record["stacks"][:2] == ["Timeout (0:00:05)!", "  File x in step"] and len(record["stacks"]) == 60


def test_a_worker_that_ends_with_the_run_leaves_no_record(server, worker):
    early, first, second = worker("w0"), worker("w1"), worker("w2")
    early.close()
    server.wait("crash")
    for name, text in (("w0", "Timeout (0:00:05)!"), ("w1", ""), ("w2", "")):
        crash_reports.stacks_of(server.folder, name).write_text(text)
    server.worker_api.finish()
    server.ask("w1")
    first.close()
    second.close()
    server.worker_api.wait_until_gone(timeout_s=30.0)
    assert server.worker_api.known.alive == {"w0": False, "w1": False, "w2": False}
    assert sorted(path.name for path in (server.folder / "crashes").iterdir()) == ["w0-1.json", "w0.stacks"]


def test_a_disconnected_worker_that_is_back_keeps_its_job(server, worker):
    for times in range(3):
        link = worker("w0")
        server.ask("w0")
        link.close()
        server.wait("worker", 2 * times + 2)
    worker("w0")
    assert server.wait("worker")[-1]["text"] == "worker w0 is back"
    assert decoded(server.run, server.ask("w1")[1]["job"]) == server.jobs[1], "w0 holds the first job"


def test_the_learner_records_a_failed_job_if_the_worker_could_not(server):
    server.ask("w0")
    server.fail("w0", server.jobs[0])
    (event,) = server.wait("crash")
    path = server.folder / "crashes" / "w0-1.json"
    assert event["text"] == f"worker w0: job pretrain/0/0 failed: ValueError: no (room.py:3); {path}"
    assert records(server) == {"w0-1.json": {**RECORD, "worker": "w0"}}


def test_a_job_can_end_the_run_if_its_worker_holds_it(server):
    server.ask("w0")
    server.fail("w1", server.jobs[0], ends_run="not mine")
    assert server.failures == []
    server.fail("w0", server.jobs[0], ends_run="2 experts failed:\nuse --sac.failed-experts teach")
    assert server.failures == ["pretrain/0/0: 2 experts failed: use --sac.failed-experts teach"]


def test_a_record_of_the_worker_is_named_and_not_written_again(server):
    server.ask("w0")
    path = crash_reports.write(server.folder, {**RECORD, "worker": "w0"})
    server.fail("w0", server.jobs[0], file=path.name)
    assert server.wait("crash")[0]["text"].endswith(f"; {path}")
    server.ask("w0")
    server.fail("w0", server.jobs[0], file="another.json")
    assert server.wait("crash", 2)[1]["text"].endswith("w0-2.json")
    with pytest.raises(Refused, match="name a file of the folder crashes"):
        server.fail("w0", server.jobs[0], file="../../elsewhere.json")
    assert sorted(records(server)) == ["w0-1.json", "w0-2.json"]


def test_a_quarantine_is_reported_once_and_the_run_continues(server):
    failing = server.jobs[0].variations[4]
    while (answer := server.ask("w0"))[0] == "job":
        job = decoded(server.run, answer[1]["job"])
        if failing in job.variations:
            server.fail("w0", job)
        else:
            for identity in job.identities():
                server.scheduler.received(identity, 0.0)
    (event,) = server.wait("quarantine")
    assert (event["identity"], event["cause"]) == ("pretrain/0/1/1", "ValueError: no (room.py:3)")
    assert event["text"] == "variation pretrain/0/1/1 is quarantined, the run continues without it: ValueError: no (room.py:3)"
    assert len(server.wait("crash", 3)) == 3 and not server.failures
    assert server.scheduler.done("pretrain", 0) and server.scheduler.progress("pretrain", 0) == (34, 34)
    assert server.scheduler.quarantine_causes() == [("pretrain/0/1/1", "ValueError: no (room.py:3)")]


def test_the_cause_of_a_quarantine_by_death_names_worker_and_stacks(server, worker):
    single = dataclasses.replace(server.jobs[0], variations=server.jobs[0].variations[:1], tasks=1)
    server.scheduler.open([single], lambda job: ())
    for death in range(3):
        link = worker(f"w{death}")
        server.ask(f"w{death}")
        stacks = crash_reports.stacks_of(server.folder, f"w{death}")
        stacks.parent.mkdir(exist_ok=True)
        stacks.write_text("Fatal Python error: Segmentation fault\n")
        link.close()
        server.wait("crash", death + 1)
    assert server.wait("quarantine")[0]["cause"] == "worker w2 died: Fatal Python error: Segmentation fault"


def test_a_quarantine_is_released_when_workers_were_lost_with_their_nodes(server, worker):
    single = dataclasses.replace(server.jobs[0], variations=server.jobs[0].variations[:1], tasks=1)
    server.scheduler.open([single], lambda job: ())
    keep = server.jobs[1]
    server.scheduler.open([dataclasses.replace(keep, stage="adapt")], lambda job: ())
    server.worker_api.lost_with_node(["w0"])
    for death in range(4):
        link = worker(f"w{death}")
        assert decoded(server.run, server.ask(f"w{death}")[1]["job"]) == single
        link.close()
        server.wait("crash", death + 1)
    server.wait("quarantine")
    server.worker_api.lost_with_node(["w1", "w2", "w3"])
    assert server.wait("released")[0]["text"].startswith("variation pretrain/0/0/0 is leased again")
    assert decoded(server.run, server.ask("w4")[1]["job"]) == single and not server.scheduler.quarantined


def test_a_run_in_which_every_job_fails_ends_with_the_cause(server):
    while not server.failures:
        kind, fields = server.ask("w0")
        assert kind == "job"
        server.fail("w0", decoded(server.run, fields["job"]))
    (line,) = server.failures
    assert line.startswith("pretrain/0: no trajectory was stored, and 8 of its variations are quarantined")
    assert line.endswith("first: ValueError: no (room.py:3)")


def test_a_phase_with_only_quarantined_variations_ends_the_run(server):
    single = dataclasses.replace(server.jobs[0], variations=server.jobs[0].variations[:1], tasks=1)
    server.scheduler.open([single], lambda job: ())
    for _ in range(3):
        assert not server.failures
        server.ask("w0")
        server.fail("w0", single)
    assert server.failures[0].startswith("pretrain/0: no trajectory was stored, and 1 of")


def test_a_record_that_cannot_be_written_is_reported(server):
    (server.folder / "crashes").write_text("a file is in the way")
    server.ask("w0")
    server.fail("w0", server.jobs[0])
    assert "its crash record cannot be written" in server.wait("crash")[0]["text"]


def test_long_work_is_listed_while_its_worker_is_connected_and_notes_are_reported(server, worker):
    assert server.worker_api.known.long_work == []
    links = {name: worker(name) for name in ("w1", "w0")}
    for name, text in (("w0", "4 experts at 1,000 of 12,000 steps"), ("w1", "")):
        server.ask(name, doing=text)
    assert server.worker_api.known.long_work == ["w0: 4 experts at 1,000 of 12,000 steps"]
    server.ask("w1", doing="x" * 1000)
    assert [len(text) for text in server.worker_api.known.long_work] == [
        len("w0: 4 experts at 1,000 of 12,000 steps"),
        len("w1: ") + 100,
    ]
    links["w0"].close()
    server.wait("worker", 3)
    assert [text[:3] for text in server.worker_api.known.long_work] == ["w1:"]
    assert server.request("note", "w1", text="2 experts from the cache")[0] == "noted"
    assert server.wait("note")[0]["text"] == "worker w1: 2 experts from the cache"
    with pytest.raises(Refused, match="use hello, ask, failed or note"):
        server.request("unknown", "w1")
