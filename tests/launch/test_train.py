"""Run folders that are resumed or refused, and the learner as a child process: messages to it, and a restart."""

import contextlib
import os
import sys
import time
from dataclasses import replace
from types import SimpleNamespace
from typing import cast

import pytest

from actors import fleet
from icrl_dist.config.run import ConfigError, dumps, load, override
from icrl_dist.launch import auto, learner_process, train
from icrl_dist.launch.learner_process import TrainFailed
from icrl_dist.models import kernel
from icrl_dist.models.compiled import Unusable
from learner.__main__ import _read_driver
from learner.service import Service


@pytest.fixture
def learner(tmp_path, monkeypatch):
    """A learner process that copies its standard input to the file ``received``."""
    program = tmp_path / "program"
    program.write_text('#!/bin/sh\nwhile read line; do echo "$line" >> "$4/received"; done\n')
    program.chmod(0o755)
    monkeypatch.setattr(sys, "executable", str(program))
    process = learner_process.LearnerProcess(tmp_path, "tcp/127.0.0.1:0", 1)
    yield process
    process.end()


def until(condition):
    deadline = time.monotonic() + 30
    while not condition():
        assert time.monotonic() < deadline
        time.sleep(0.01)


def test_a_learner_receives_the_workers_lost_with_a_node_and_a_restarted_one_receives_all(learner, tmp_path):
    received = tmp_path / "received"
    for workers in ([], ["w0"], ["w0"], ["w0", "w1", "w2"]):
        learner.excuse(workers)
    until(lambda: received.exists() and received.read_text() == '{"lost": ["w0"]}\n{"lost": ["w1", "w2"]}\n')
    learner._process.kill()
    learner._process.wait()
    learner.excuse(["w0", "w1", "w2", "w3"])  # the process is dead
    learner.watch(lambda event: None)
    until(lambda: received.read_text().endswith('\n{"lost": ["w0", "w1", "w2", "w3"], "processes": []}\n'))


def test_what_the_driver_sends_reaches_the_learner():
    received, processes, (read, write) = list[list[str]](), list[tuple[int, float]](), os.pipe()
    os.write(write, b'{"lost": ["w0"]}\n{"processes": [[1, 2.5]]}\n{"lost": ["w1", "w2"], "processes": []}\n')
    os.close(write)
    service = SimpleNamespace(worker_api=SimpleNamespace(lost_with_node=received.append))
    _read_driver(cast(Service, service), processes, read)
    os.close(read)
    assert received == [["w0"], ["w1", "w2"]] and processes == [(1, 2.5)]


def test_a_run_resumes_with_another_endpoint_but_not_with_another_seed(small_run, tmp_path):
    folder = tmp_path / "run"
    train.prepare(small_run, folder, resume=False, overwrite=False)
    file = folder / "run.toml"
    os.utime(file, (1e9, 1e9))
    moved = override(small_run, ["stream.endpoint=tls/10.0.0.9:7447", "stream.certificates=/c"], "--set")
    train.prepare(moved, folder, resume=True, overwrite=False)
    assert load(str(file)) == moved and file.stat().st_mtime == 1e9
    with pytest.raises(ConfigError, match="has other settings"):
        train.prepare(override(moved, ["seed=7"], "--set"), folder, resume=True, overwrite=False)


def test_a_run_keeps_its_decoder_and_is_refused_where_the_kernel_that_it_needs_is_missing(small_run, tmp_path, monkeypatch):
    def decoder(there, asked, resume=True):
        (tmp_path / "run.toml").write_text(dumps(by(there)))
        return auto.without_auto(by(asked), tmp_path, resume, notes.append).context.decoder

    notes: list[str] = []
    by = lambda decoder: replace(small_run, context=replace(small_run.context, decoder=decoder))  # noqa: E731
    monkeypatch.setattr(kernel, "library", lambda name: Unusable("not compiled", "run `make kernel`"))
    monkeypatch.setattr(kernel, "kinds", lambda: ())
    assert decoder("torch", "auto") == decoder("torch", "torch") == "torch" and not notes
    assert decoder("kernel", "auto", resume=False) == "torch"
    assert [note.split(". ")[0] for note in notes] == ["compiled decoder: not compiled: run `make kernel`"]
    for there, asked, resume in (("kernel", "auto", True), ("kernel", "kernel", True), ("torch", "kernel", False)):
        with pytest.raises(
            ConfigError, match=r"^context\.decoder = 'kernel': on .*: not compiled: run `make kernel`; or begin"
        ):
            decoder(there, asked, resume)
    monkeypatch.setattr(kernel, "kinds", lambda: ("avx2",))
    monkeypatch.setattr(kernel, "library", lambda name: None)
    assert decoder("torch", "auto") == "torch" and decoder("kernel", "auto") == decoder("torch", "auto", False) == "kernel"
    assert len(notes) == 1


def test_an_absent_cluster_leaves_no_run_folder(small_run, tmp_path, monkeypatch):
    def absent(*_):
        raise ConfigError("--address auto: no cluster")

    monkeypatch.setattr(fleet, "Fleet", absent)
    train.prepare(small_run, tmp_path / "run", resume=False, overwrite=False)
    with pytest.raises(ConfigError, match="no cluster"):
        train.train_ray(small_run, tmp_path / "run", None, "auto", print)
    assert not (tmp_path / "run").exists()


class FakeLearner:
    """A learner process whose events are given, one list for each look at them."""

    endpoint, deaths = "tcp/127.0.0.1:1", 0

    def __init__(self, *looks):
        self.looks = list(looks)

    def events(self):
        return self.looks.pop(0) if self.looks else []

    def watch(self, report):
        pass

    excuse = end_after_driver = watch


@pytest.fixture
def run_with(small_run, tmp_path, monkeypatch):
    """``run_with(outcome, *looks)``: train with a fleet whose ``watch`` returns or raises ``outcome``."""
    folder = tmp_path / "run"

    def run(outcome, *looks, files=()):
        class Fleet:
            deaths, ray_restarts, lost = 0, 0, ()

            def __init__(self, *_):
                if outcome == "does not start":
                    raise fleet.FleetFailed("Ray did not start")

            def watch(self, *_):
                if isinstance(outcome, Exception):
                    raise outcome
                return outcome

            gather = start = close = lambda self, *_: None

        learner = FakeLearner(*looks)
        monkeypatch.setattr(fleet, "Fleet", Fleet)
        monkeypatch.setattr(train, "FINISH_S", 0.05)
        monkeypatch.setattr(learner_process, "running", lambda *_: contextlib.nullcontext(learner))
        train.prepare(small_run, folder, resume=False, overwrite=False)
        for name, content in files:
            (folder / name).parent.mkdir(exist_ok=True)
            (folder / name).write_bytes(content)
        return train.train_ray(small_run, folder, 1, None, lambda event: None)

    return run


LISTENING, FINISHED = {"event": "listening"}, {"event": "finished", "version": 1}


@pytest.mark.parametrize("outcome", [0, fleet.FleetFailed("Ray's process raylet (7) has ended")])
def test_a_run_whose_learner_has_finished_is_finished_whatever_its_workers_did(run_with, outcome):
    """A command that was stopped sees the end of the workers first, although the learner ended them."""
    result = run_with(outcome, [LISTENING], [FINISHED])
    assert result == {"version": 1, "learner_deaths": 0, "worker_deaths": 0}


def test_a_run_whose_workers_all_ended_fails_if_its_learner_does_not_finish(run_with):
    with pytest.raises(TrainFailed, match="every worker ended before the run did"):
        run_with(0, [LISTENING])


@pytest.mark.parametrize(
    ("files", "end", "kept"),
    [
        ([("checkpoints/version-0000.npz", b"x")], "", True),
        ([("checkpoints/partial.npz", b"x")], "", True),
        ([("learner.log", b"a line\n"), ("learner.err", b"")], "; nothing has been stored yet", False),
        ([("learner.err", b"a cause\n")], "; nothing has been stored yet, see {folder}", True),
        ([("dataset/segment-000000.frames", b"damaged")], "; nothing has been stored yet, see {folder}", True),
        ([("notes.md", b"mine")], "; nothing has been stored yet, see {folder}", True),
    ],
)
@pytest.mark.parametrize("outcome", ["does not start", fleet.FleetFailed("Ray did not start")])
def test_a_failed_run_says_what_its_folder_holds_and_is_removed_if_that_is_nothing(
    run_with, tmp_path, files, end, kept, outcome
):
    with pytest.raises(TrainFailed) as failed:
        run_with(outcome, [LISTENING], files=files)
    assert str(failed.value) == "Ray did not start" + end.format(folder=tmp_path / "run")
    assert (tmp_path / "run").exists() is kept
