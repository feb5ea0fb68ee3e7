"""The learner as a child process: its events travel on a descriptor of their own, and it ends with its driver."""

import json
import os
import subprocess
import sys
import threading
import time
from types import SimpleNamespace
from typing import cast

import psutil
import pytest

from icrl_dist.launch import learner_process
from learner.__main__ import _end_with_driver, _Events
from learner.service import Service


@pytest.fixture
def start(tmp_path, monkeypatch):
    """Start a learner process that is this script of bash; ``$events`` is the descriptor of its events."""
    started = []

    def start(script):
        program = tmp_path / "program"
        program.write_text(f'#!/bin/bash\nevents=$(sed "s/.*--events \\([0-9]*\\).*/\\1/" <<< "$*")\n{script}\n')
        program.chmod(0o755)
        monkeypatch.setattr(sys, "executable", str(program))
        started.append(learner_process.LearnerProcess(tmp_path, "tcp/127.0.0.1:0", 0))
        return started[-1]

    yield start
    for process in started:
        process.end()


def texts(process, count):
    deadline, found = time.monotonic() + 30, list[str]()
    while len(found) < count:
        assert time.monotonic() < deadline
        found += [event["text"] for event in process.events()]
    return found


def test_lines_that_libraries_print_are_the_log_and_no_events(start, tmp_path):
    event = json.dumps({"event": "note", "text": "an event"})
    process = start(f"echo 'MKL_VERBOSE oneMKL 2024.0'; echo a warning >&2; echo '{event}' >&$events; echo bye")
    assert texts(process, 1) == ["an event"]
    process._process.wait()
    assert (tmp_path / "learner.err").read_text() == "MKL_VERBOSE oneMKL 2024.0\na warning\nbye\n"


def test_an_event_that_a_killed_learner_wrote_in_part_is_left_out(start):
    event = json.dumps({"event": "note", "text": "whole"})
    process = start(f"echo '{event}' >&$events; printf '%s' '{event[:10]}' >&$events; kill -9 $$")
    assert texts(process, 1) == ["whole"]
    process._process.wait()
    with pytest.raises(learner_process.TrainFailed, match="died too often"):
        process.watch(lambda event: None)


def test_a_learner_ends_in_its_own_time_when_the_run_fails(start, tmp_path):
    """Its checkpoint may take longer than the end of a learner that has finished."""
    event = json.dumps({"event": "note", "text": ""})
    checkpoint = "sleep 0.3; touch $4/checkpoint; exit 130"
    process = start(f"trap '{checkpoint}' TERM; echo '{event}' >&$events; while :; do sleep 0.05; done")
    texts(process, 1)
    process.end()
    assert (tmp_path / "checkpoint").exists()
    assert learner_process.CHECKPOINT_S >= 60


def test_a_learner_that_does_not_end_is_killed_once_its_time_is_over(start, monkeypatch):
    event = json.dumps({"event": "note", "text": ""})
    process = start(f"trap '' TERM; echo '{event}' >&$events; while :; do sleep 0.05; done")
    texts(process, 1)
    monkeypatch.setattr(learner_process, "CHECKPOINT_S", 0.3)
    process.interrupt(lambda event: None)
    assert process._process.returncode == -9


@pytest.fixture
def events():
    """The ends of a pipe for events; a test may close the reading one."""
    read, write = os.pipe()
    yield SimpleNamespace(read=read, write=write)
    os.close(write)


def test_an_event_after_the_end_of_the_driver_is_no_error(events):
    report = _Events(events.write)
    report({"event": "note"})
    assert os.read(events.read, 100) == b'{"event": "note"}\n'
    os.close(events.read)
    report({"event": "note"})


@pytest.mark.parametrize("driver", ["closed its end", "was another process"])
def test_the_learner_stops_also_if_its_driver_died_before_it_looked(events, driver):
    stopped = threading.Event()
    service = cast(Service, SimpleNamespace(stop=stopped.set))
    if driver == "closed its end":
        os.close(events.read)
        _end_with_driver(service, events.write, os.getppid(), [])
        assert stopped.wait(0.4), "at once, not at the next look at the parent"
    else:
        _end_with_driver(service, events.write, os.getpid(), [])
        assert stopped.wait(5)
        os.close(events.read)


def test_the_learner_goes_on_while_its_driver_lives(events):
    stopped = threading.Event()
    _end_with_driver(cast(Service, SimpleNamespace(stop=stopped.set)), events.write, os.getppid(), [])
    assert not stopped.wait(0.7)
    os.close(events.read)
    assert stopped.wait(5)


def test_the_learner_ends_the_processes_of_its_dead_driver_and_no_other(events):
    """Not a process that has got the number of one that ended, nor one that the driver did not start."""
    ours, reused, foreign = (subprocess.Popen(["sleep", "60"]) for _ in range(3))
    try:
        created = psutil.Process(ours.pid).create_time()
        os.close(events.read)
        service = cast(Service, SimpleNamespace(stop=lambda: None))
        _end_with_driver(service, events.write, os.getppid(), [(2**22 + 1, created), (reused.pid, 1.0), (ours.pid, created)])
        assert ours.wait(10) == -9
        assert reused.poll() is None and foreign.poll() is None
    finally:
        for process in (ours, reused, foreign):
            process.kill()
            process.wait()
