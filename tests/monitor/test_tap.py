"""The tap: which trajectories are printed, and how."""

import io
import json
import sys

import msgpack
import pytest

from icrl_dist.config import ConfigError
from icrl_dist.monitor.tap import Tapped
from icrl_dist.stream import plane, wire
from icrl_dist.types import NULL
from tests.monitor.messages import progress, trajectory


class Out(io.TextIOWrapper):
    def __init__(self):
        super().__init__(io.BytesIO(), "utf-8", write_through=True)


def tapped(monkeypatch, tasks=(), adversaries=(), every=1, form="json", count=0):
    """What is written of 24 trajectories and some messages that are none."""
    out, ended, made = Out(), [], []
    monkeypatch.setattr(sys, "stdout", out)
    tap = Tapped(tasks, adversaries, every, form, count, lambda: ended.append(True))
    for task in range(3):
        for variation in range(2):
            for trial in range(4):
                law = {"adversary": NULL} if variation == 0 else {}
                made.append(trajectory(f"adapt/0/{task}/{variation}/{trial}", **law))
    for first in range(0, len(made), 7):
        tap("key", plane.trajectories(made[first : first + 7], 0.0))
    broken = [{"identity": "x"}, {"identity": "adapt/0/0/0", "trials": [1], "returns": [], "steps": []}, 7]
    for odd in (progress(), b"garbage", *(wire.encode_message("trajectories", variations=[one]) for one in broken)):
        tap("key", odd)
    return out.buffer.getvalue(), len(ended)


def identities(written):
    return [json.loads(line)["identity"] for line in written.decode().splitlines()]


def test_everything_unless_told_otherwise(monkeypatch):
    written, ended = tapped(monkeypatch)
    assert len(identities(written)) == 24 and not ended


def test_by_task_and_by_adversary(monkeypatch):
    assert identities(tapped(monkeypatch, tasks=(2,), adversaries=("null",))[0]) == [f"adapt/0/2/0/{n}" for n in range(4)]
    assert identities(tapped(monkeypatch, tasks=(0, 1), adversaries=("1",))[0])[-1] == "adapt/0/1/1/3"
    assert identities(tapped(monkeypatch, adversaries=("dirichlet", "0"))[0]) == identities(tapped(monkeypatch)[0])


def test_every_so_manyth_of_those_and_no_more_than_asked(monkeypatch):
    written, ended = tapped(monkeypatch, tasks=(1,), every=3, count=2)
    assert identities(written) == ["adapt/0/1/0/0", "adapt/0/1/0/3"] and ended == 1


def test_as_messages_of_their_own(monkeypatch):
    written, _ = tapped(monkeypatch, tasks=(1,), form="msgpack")
    found = list(msgpack.Unpacker(io.BytesIO(written)))
    assert len(found) == 8 and found[0]["identity"] == "adapt/0/1/0/0" and found[0]["v"] == 1


@pytest.mark.parametrize("odd", [{"every": 0}, {"count": -1}, {"tasks": (-3,)}])
def test_numbers_that_cannot_be(monkeypatch, odd):
    with pytest.raises(ConfigError, match="must be at least"):
        tapped(monkeypatch, **odd)
