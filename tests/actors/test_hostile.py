"""Real worker processes with an environment in which one variation raises, kills its process, or hangs."""

import contextlib
import gc
import json
import os
import subprocess
import sys
import threading
import time
from pathlib import Path
from typing import Any

import psutil
import pytest

from actors.fleet import Fleet, FleetFailed
from icrl_dist.stream import batching, wire
from icrl_dist.stream.link import StreamKeys
from icrl_dist.stream.zenoh_link import ZenohLink
from learner.scheduler import LeaseScheduler
from learner.worker_api import WorkerAPI
from tests.e2e.training import wait_for
from tests.jobs import jobs_of

KEYS = StreamKeys("test")
HOSTILE = Path(__file__).parent / "hostile"
WORKER = """  # hostile-worker
import sys
from pathlib import Path
from typing import Any
import torch
from actors.worker import Worker
from icrl_dist.stream.zenoh_link import ZenohLink
torch.set_num_threads(1)
endpoint, name, folder = sys.argv[1:]
with ZenohLink.connect(endpoint, timeout_s=30.0) as link:
    Worker(link, "test", name, folder=Path(folder)).run()
"""


class LearnerSide:
    """A LeaseScheduler and a WorkerAPI on a real link; received trajectories are kept by identity."""

    def __init__(self, run, folder, lease_s):
        self.run, self.folder, self.stored = run, folder, {}
        self.events: list[dict[str, Any]] = []
        self.failures: list[str] = []
        self.jobs = jobs_of(run, "icag")[:2]
        self.everything = {i for job in self.jobs for i in job.identities()}
        self.lock = threading.Lock()
        self.scheduler = LeaseScheduler(lease_s, floor_s=lease_s)
        self.scheduler.open(self.jobs, lambda job: ())
        self.link = ZenohLink.listen("tcp/127.0.0.1:0")
        arguments = self.link, KEYS, self.scheduler, self.lock, self.events.append, self.failures.append
        self.worker_api = WorkerAPI(run, folder, *arguments)
        self.link.serve(KEYS.data, self.take)

    @property
    def endpoint(self):
        return self.link.endpoints[0]

    def take(self, query):
        for one in batching.split(query, 1 << 20):
            identity = wire.decode_trajectory(one.payload, 1 << 20).identity
            with self.lock:
                if self.scheduler.pending_job(identity):
                    assert identity not in self.stored
                    self.stored[identity] = one.payload
                    self.scheduler.received(identity, time.monotonic())
                    done = self.scheduler.done("pretrain", 0)
                else:
                    self.scheduler.repeated(identity, time.monotonic())
                    done = False
            one.reply(b"stored")
            if done:
                self.worker_api.finish()

    def done(self):
        with self.lock:
            done = self.scheduler.done("pretrain", 0)
        if done:
            self.worker_api.finish()
        return done

    def events_of(self, kind):
        return [event for event in list(self.events) if event["event"] == kind]

    def records(self):
        return [json.loads(path.read_text()) for path in sorted((self.folder / "crashes").glob("*.json"))]

    def close(self):
        self.worker_api.close()
        self.link.close()


@pytest.fixture
def learner(small_run, tmp_path):
    """``learner(lease_s)``: the learner side of a phase with two jobs."""
    with contextlib.ExitStack() as stack:

        def made(lease_s):
            one = LearnerSide(small_run, tmp_path, lease_s)
            stack.callback(one.close)
            return one

        yield made


@pytest.fixture
def hostile(small_run, monkeypatch):
    """``hostile(failure)``: in processes started later, the second variation of the second task fails in this way."""

    def begin(failure):
        job = jobs_of(small_run, "icag")[0]
        monkeypatch.setenv("HOSTILE", failure)
        monkeypatch.setenv("HOSTILE_VARIATION", repr(job.variations[4]))
        monkeypatch.setenv("PYTHONPATH", os.pathsep.join([str(HOSTILE), str(HOSTILE.parents[2])]))

    return begin


CULPRIT = "pretrain/0/1/1"


@pytest.fixture
def worker(learner):
    """``worker(learner, name)``: a worker in its own process, which ends with the test at the latest."""
    with contextlib.ExitStack() as stack:

        def start(learner, name):
            process = subprocess.Popen(
                [sys.executable, "-c", WORKER, learner.endpoint, name, str(learner.folder)], stderr=subprocess.PIPE, text=True
            )
            stack.callback(process.communicate)
            stack.callback(process.kill)
            return process

        yield start


def test_a_variation_that_raises_is_quarantined_and_its_worker_continues(learner, hostile, worker):
    hostile("raise")
    learner = learner(60.0)
    process = worker(learner, "w0")
    wait_for(learner.done, "the rest of the phase")
    _, log = process.communicate(timeout=100)
    assert process.returncode == 0, log
    assert {i for i in learner.everything if i not in learner.stored} == {
        i for i in learner.everything if str(i).startswith(f"{CULPRIT}/")
    }
    ((name, cause),) = learner.scheduler.quarantine_causes()
    assert name == CULPRIT and cause.startswith("ZeroDivisionError: the room broke (sitecustomize.py:")
    assert [event["identity"] for event in learner.events_of("quarantine")] == [CULPRIT]
    assert [record["job"] for record in learner.records()] == ["pretrain/0/0"] * 2 + [CULPRIT]
    assert learner.records()[2]["identity"] == f"{CULPRIT}/0" and "raise_an_error" in learner.records()[2]["traceback"]
    assert sorted(path.name for path in (learner.folder / "crashes").iterdir()) == [f"w0-{n}.json" for n in (1, 2, 3)]


@pytest.mark.parametrize(("failure", "function"), [("sleep", "sleep_for_ever"), ("hold", "hold_the_interpreter_in_c")])
def test_a_stuck_worker_writes_its_stacks_and_ends_and_another_does_its_job(
    learner, hostile, worker, monkeypatch, failure, function
):
    hostile(failure)
    learner = learner(5.0)
    process = worker(learner, "w0")
    _, log = process.communicate(timeout=150)
    assert process.returncode == 1, log
    stacks = (learner.folder / "crashes" / "w0.stacks").read_text()
    assert stacks.startswith("Timeout (0:00:0") and f" in {function}" in stacks and " in behavior_contexts" in stacks
    assert (" in _dump_and_exit" in stacks) is (failure == "sleep"), "the Python thread writes them whenever it can run"
    wait_for(lambda: learner.events_of("crash"), "the record")
    (record,) = learner.records()
    assert (record["what"], record["job"]) == ("vanished", "pretrain/0/0")
    assert record["last_heartbeat"]["episodes"] == 0
    if failure == "sleep":  # heartbeats continue, but not while another thread holds the interpreter lock
        assert record["last_heartbeat"]["job"] == "pretrain/0/0" and record["last_heartbeat"]["memory_mb"] > 10
    assert any(function in line for line in record["stacks"])
    monkeypatch.delenv("HOSTILE")
    process = worker(learner, "w0-1")
    wait_for(learner.done, "the phase")
    _, log = process.communicate(timeout=100)
    assert process.returncode == 0, log
    assert set(learner.stored) == learner.everything and not learner.scheduler.quarantined
    assert not (learner.folder / "crashes" / "w0-1.stacks").exists(), "it was empty"


def test_a_crash_in_c_writes_the_stacks(learner, hostile, worker):
    hostile("segfault")
    learner = learner(60.0)
    process = worker(learner, "w0")
    process.communicate(timeout=150)
    assert process.returncode < 0
    wait_for(lambda: learner.events_of("crash"), "the record")
    (record,) = learner.records()
    assert record["stacks"][0] == "Fatal Python error: Segmentation fault"
    assert any("behavior_contexts" in line for line in record["stacks"])


@pytest.fixture
def fleet():
    """``fleet(actors, restarts)``: a real fleet, on any number of cores."""
    with contextlib.ExitStack() as stack:

        def made(actors, restarts, **options):
            one = Fleet(actors, restarts, oversubscribe=True, **options)
            stack.callback(one.close)
            return one

        yield made


# The processes of a failed start of Ray are ended, but Ray's own objects for them are only garbage-collected.
LEFT_OBJECTS = pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")


def kill_rays_node_once():
    """Kill Ray's node process as soon as this process has one among its descendants."""

    def killed():
        for process in psutil.Process().children(recursive=True):
            with contextlib.suppress(psutil.NoSuchProcess):
                if process.name() == "raylet":
                    process.kill()
                    return True
        return False

    wait_for(killed, "Ray's node")


@LEFT_OBJECTS
def test_a_variation_that_kills_its_worker_three_times_is_quarantined_and_the_others_finish(learner, hostile, fleet):
    hostile("kill")
    learner, fleet, notes = learner(60.0), fleet(1, 3), list[str]()
    gc.collect()
    fleet.start(learner.endpoint, "test", learner.folder)
    wait_for(
        lambda: (fleet.watch(notes.append, 1), learner.done())[1], "the rest of the phase", 200
    )  # progress 1: a spare is kept
    wait_for(lambda: not fleet.watch(notes.append, 0), "the worker's end")
    assert (fleet.deaths, len(notes)) == (3, 3) and all("starting it again" in note for note in notes)
    missing = learner.everything - set(learner.stored)
    assert missing == {i for i in learner.everything if str(i).startswith(f"{CULPRIT}/")}
    ((name, cause),) = learner.scheduler.quarantine_causes()
    assert (name, cause) == (CULPRIT, "worker w0-2 died")
    assert [event["identity"] for event in learner.events_of("quarantine")] == [CULPRIT]
    wait_for(lambda: len(learner.events_of("crash")) == 3, "the records")
    assert sorted(record["job"] for record in learner.records()) == ["pretrain/0/0", "pretrain/0/0", CULPRIT]


@LEFT_OBJECTS
def test_a_fleet_starts_although_rays_node_died_and_fails_when_a_worker_dies_repeatedly(learner, hostile, fleet):
    hostile("exit")
    killer, notes = threading.Thread(target=kill_rays_node_once), list[str]()
    killer.start()
    learner, fleet = learner(60.0), fleet(1, 1, note=notes.append)
    killer.join()
    gc.collect()
    tries = len(notes)  # a busy machine may need one more attempt
    assert tries >= 1 and all(": starting it again, " in note for note in notes)
    fleet.start(learner.endpoint, "test", learner.folder)
    with pytest.raises(FleetFailed, match="worker w0 died 2 times without progress"):
        wait_for(lambda: fleet.watch(notes.append, 7) and False, "the failure of the fleet", 100)
    assert (fleet.deaths, len(notes)) == (2, tries + 1)
