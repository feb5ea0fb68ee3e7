"""The learner as a child process: what it is told, and a child that dies."""

import os
import time
from types import SimpleNamespace

import pytest

from icrl_dist import launch
from learner.__main__ import _listen


@pytest.fixture
def child(tmp_path, monkeypatch):
    """A learner that writes what it is told into ``told``, as long as it lives."""
    program = tmp_path / "program"
    program.write_text('#!/bin/sh\nwhile read line; do echo "$line" >> "$3/told"; done\n')
    program.chmod(0o755)
    monkeypatch.setattr(launch.sys, "executable", str(program))
    made = launch._Learner(tmp_path, "tcp/127.0.0.1:0", 1)
    yield made
    made.end()


def until(condition):
    deadline = time.monotonic() + 30
    while not condition():
        assert time.monotonic() < deadline
        time.sleep(0.01)


def test_a_learner_is_told_who_went_with_a_machine_and_the_next_one_of_all(child, tmp_path):
    told = tmp_path / "told"
    for workers in ([], ["w0"], ["w0"], ["w0", "w1", "w2"]):
        child.excuse(workers)
    until(lambda: told.exists() and told.read_text() == '["w0"]\n["w1", "w2"]\n')
    child._process.kill()
    child._process.wait()
    child.excuse(["w0", "w1", "w2", "w3"])  # nobody reads it
    child.watch(lambda event: None)
    until(lambda: told.read_text().endswith('\n["w0", "w1", "w2", "w3"]\n'))


def test_what_it_is_told_goes_to_the_desk():
    heard, (read, write) = [], os.pipe()
    os.write(write, b'["w0"]\n["w1", "w2"]\n')
    os.close(write)
    _listen(SimpleNamespace(desk=SimpleNamespace(excuse=heard.append)), read)
    os.close(read)
    assert heard == [["w0"], ["w1", "w2"]]
