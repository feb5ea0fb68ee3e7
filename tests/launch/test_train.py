"""Run folders that are taken up or refused, and the learner as a child process: what it is told, and one that dies."""

import os
import time
from types import SimpleNamespace

import pytest

from actors import fleet
from icrl_dist.config.run import ConfigError, load, override
from icrl_dist.launch import learner_process, train
from learner.__main__ import _read_lost_workers


@pytest.fixture
def learner(tmp_path, monkeypatch):
    """A learner that writes what it is told into ``told``, as long as it lives."""
    program = tmp_path / "program"
    program.write_text('#!/bin/sh\nwhile read line; do echo "$line" >> "$3/told"; done\n')
    program.chmod(0o755)
    monkeypatch.setattr(learner_process.sys, "executable", str(program))
    made = learner_process.Learner(tmp_path, "tcp/127.0.0.1:0", 1)
    yield made
    made.end()


def until(condition):
    deadline = time.monotonic() + 30
    while not condition():
        assert time.monotonic() < deadline
        time.sleep(0.01)


def test_a_learner_is_told_who_went_with_a_machine_and_the_next_one_of_all(learner, tmp_path):
    told = tmp_path / "told"
    for workers in ([], ["w0"], ["w0"], ["w0", "w1", "w2"]):
        learner.excuse(workers)
    until(lambda: told.exists() and told.read_text() == '["w0"]\n["w1", "w2"]\n')
    learner._process.kill()
    learner._process.wait()
    learner.excuse(["w0", "w1", "w2", "w3"])  # nobody reads it
    learner.watch(lambda event: None)
    until(lambda: told.read_text().endswith('\n["w0", "w1", "w2", "w3"]\n'))


def test_workers_lost_with_nodes_reach_the_worker_api():
    heard, (read, write) = [], os.pipe()
    os.write(write, b'["w0"]\n["w1", "w2"]\n')
    os.close(write)
    _read_lost_workers(SimpleNamespace(worker_api=SimpleNamespace(lost_with_node=heard.append)), read)
    os.close(read)
    assert heard == [["w0"], ["w1", "w2"]]


def test_a_run_goes_on_where_another_head_listens_and_with_no_other_number(small_run, tmp_path):
    folder = tmp_path / "run"
    train.prepare(small_run, folder, resume=False, overwrite=False)
    file = folder / "run.toml"
    os.utime(file, (1e9, 1e9))
    elsewhere = override(small_run, ["stream.endpoint=tls/10.0.0.9:7447", "stream.certificates=/c"], "--set")
    train.prepare(elsewhere, folder, resume=True, overwrite=False)
    assert load(str(file)) == elsewhere and file.stat().st_mtime == 1e9
    with pytest.raises(ConfigError, match="has other numbers"):
        train.prepare(override(elsewhere, ["seed=7"], "--set"), folder, resume=True, overwrite=False)
    with pytest.raises(ConfigError, match="has other numbers"):
        train.prepare(override(elsewhere, ["stream.credits=3"], "--set"), folder, resume=True, overwrite=False)


def test_a_cluster_that_is_not_there_leaves_no_folder(small_run, tmp_path, monkeypatch):
    def absent(*_):
        raise ConfigError("--address auto: nobody there")

    monkeypatch.setattr(fleet, "Fleet", absent)
    train.prepare(small_run, tmp_path / "run", resume=False, overwrite=False)
    with pytest.raises(ConfigError, match="nobody there"):
        train.train_ray(small_run, tmp_path / "run", None, "auto", print)
    assert not (tmp_path / "run").exists()
