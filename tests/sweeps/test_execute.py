"""Runs side by side, with processes that only pretend to work."""

import errno
import json
import os
import threading
from pathlib import Path
from typing import Any

import pytest

from icrl_dist.launch.learner_process import TrainFailed
from icrl_dist.storage.files import StoreError
from icrl_dist.sweeps import execute, file, one, plan, processes, state, sweep
from icrl_dist.sweeps.execute import Execution
from icrl_dist.sweeps.one import Work
from icrl_dist.sweeps.state import State
from tests.sweeps.files import written


class Pretended:
    """Processes that end after some polls with the exit code of their method, and write their state as a run does."""

    def __init__(self, codes):
        self.codes, self.running, self.most, self.stopped, self.killed = codes, 0, 0, [], []

    def __call__(self, message, log):
        assert log.parent.is_dir()
        return _Process(self, Work.read(message))


class _Process:
    error = ""

    def __init__(self, owner, work):
        self.owner, self.work, self.polls, self.code = owner, work, 0, None
        owner.running += 1
        owner.most = max(owner.most, owner.running)

    def poll(self):
        self.polls += 1
        wanted = self.owner.codes.get(self.work.member.variant, 0)
        if self.code is None and self.polls == 3 and wanted is not None:
            self._end(wanted)
        return self.code

    def stop(self):
        self.owner.stopped.append(self.work.member.name)
        if self.work.member.variant != "exact":
            self._end(130)

    def kill(self):
        self.owner.killed.append(self.work.member.name)
        self._end(-9)

    def _end(self, code):
        self.code = code
        self.owner.running -= 1
        member, folder = self.work.member, self.work.member.place(self.work.out)
        evaluations = {name: {"settings": plan.digest(member, one), "files": []} for name, one in member.evaluations.items()}
        found = (
            State(evaluations=evaluations, collected=list(evaluations), returns={"0": 5.0}) if code == 0 else State(failed="no")
        )
        state.file_of(folder).write_text(json.dumps(vars(found)))


@pytest.fixture
def members(tmp_path):
    return plan.members(file.read(path := written(tmp_path)), path)


def test_at_most_so_many_runs_at_a_time_and_one_that_fails_is_listed_with_its_cause(tmp_path, members):
    start = Pretended({"dpt": 1, "icag-k2": -9})
    events: list[dict[str, Any]] = []
    execution = Execution(members, 0, tmp_path, "weights", 3, start)
    assert execution.run(events.append, lambda: False)
    assert start.most == 3 and start.running == 0 and not start.stopped
    causes = {one.member.name: one.cause for one in execution.failures}
    killed = "its process was ended by SIGKILL"
    assert causes == {
        f"{name}/{seed}": cause
        for name, cause in (("override/dpt", "no"), ("strong/dpt", "no"), ("override/icag-k2", killed))
        for seed in (0, 1)
    }
    assert all(one.log.name == f"{one.member.seed}.log" for one in execution.failures)
    notes = [event["text"] for event in events if event["event"] == "note"]
    assert len(notes) == 10 and any(note == "strong/exact/1: done in 0:00, return 5.00 (p = 0)" for note in notes)
    assert events[-1]["step"] == events[-1]["steps"] and events[-1]["text"] == "10/10 runs"


FULL = """
import errno, os, sys
def full(_): raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
os.fsync = full
from icrl_dist.sweeps import one
sys.exit(one.main())
"""


@pytest.mark.integration
def test_a_full_disk_is_named_with_the_command_of_the_sweep(tmp_path, members, monkeypatch):
    """Neither the state nor the log of the run can be written."""
    monkeypatch.setattr(processes, "COMMAND", ("-c", FULL))
    folder = members[0].place(tmp_path)
    folder.parent.mkdir(parents=True)
    state.log_of(folder).symlink_to("/dev/full")
    execution = Execution(members[:1], 0, tmp_path, "weights", 1, processes.Child)
    notes: list[dict[str, Any]] = []
    assert execution.run(notes.append, lambda: False)
    expected = (
        f"{state.file_of(folder)}: could not be written (No space left on device): "
        "free space, then repeat the command of the sweep"
    )
    assert [one.cause for one in execution.failures] == [expected]
    assert any(expected in str(note["text"]) for note in notes)


def test_the_sweeps_own_files_on_a_full_disk_name_its_command(tmp_path, monkeypatch):
    def full(_):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    path = written(tmp_path)
    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(
        StoreError, match=r"sweep.json: could not be written .*: free space, then repeat the command of the sweep"
    ):
        sweep.sweep(path, tmp_path / "out")


def test_why_a_run_failed_is_not_hidden_by_its_state(tmp_path, members, monkeypatch):
    def fails(*_):
        monkeypatch.setattr(os, "fsync", full)
        raise TrainFailed("all workers died")

    def full(_):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(one, "_train", fails)
    with pytest.raises(TrainFailed, match="all workers died"):
        one.do(Work(members[0], tmp_path, "weights"))


def test_a_stop_ends_every_running_process_and_kills_one_that_does_not_end(tmp_path, members, monkeypatch):
    monkeypatch.setattr(execute, "STOP_S", 0.2)
    start, asked = Pretended(dict.fromkeys(("dpt", "icag-k2", "exact"))), threading.Event()
    execution = Execution(members, 0, tmp_path, "weights", 4, start)

    def show(event):
        asked.set()

    assert not execution.run(show, asked.is_set)
    assert start.stopped == [one.name for one in members[:4]] and start.killed == ["override/exact/0"]
    assert start.running == 0


def test_what_a_child_is_told_is_what_was_planned(tmp_path, members):
    work = Work(members[0], Path(tmp_path), "rows")
    assert Work.read(work.message()) == work and work.message().count(b"\n") == 1


def test_changed_settings_of_a_run_that_exists_are_refused(tmp_path, members):
    from icrl_dist.config.run import ConfigError, dumps, override

    one, folder = members[0], tmp_path / "0"
    evaluations = {name: {"settings": plan.digest(one, of), "files": []} for name, of in one.evaluations.items()}
    same = State(run=dumps(one.run), evaluations=evaluations, collected=list(evaluations))
    state.check(same, one, folder)
    assert same.done(one)
    other = State(run=dumps(override(one.run, ["pretrain.steps=61"], "")))
    with pytest.raises(ConfigError, match=r"pretrain.steps = 61 there and 60 here; use another --out, or delete .*/0"):
        state.check(other, one, folder)
    with pytest.raises(ConfigError, match="evaluation unseen there has other settings; give this one another name"):
        state.check(State(evaluations=evaluations | {"unseen": {"settings": "", "files": []}}), one, folder)
    with pytest.raises(ConfigError, match="has method 'exact', and the one in the sweep file has not"):
        state.check(State(run=dumps(one.run), exact=True), one, folder)
    with pytest.raises(ConfigError, match="evaluation unseen is new, and --keep rows has deleted the weights"):
        state.check(State(evaluations={"online": evaluations["online"]}, collected=["online"], kept="rows"), one, folder)


def test_a_run_whose_folder_was_deleted_begins_anew(tmp_path):
    folder = tmp_path / "0"
    state.file_of(folder).write_text(json.dumps(vars(State(run="x", kept="weights"))))
    assert state.load(folder) == State()
    state.file_of(folder).write_text(json.dumps(vars(State(run="x", kept="rows"))))
    assert state.load(folder).run == "x"
