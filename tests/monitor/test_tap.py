"""The tap: which trajectories are printed, and how."""

import io
import json
import os
import signal
import sys
import threading

import msgpack
import pytest

from icrl_dist.cli.main import main
from icrl_dist.config.run import ConfigError
from icrl_dist.monitor.tap import TapWriter
from icrl_dist.stream import monitor_messages, wire
from icrl_dist.stream.zenoh_link import ZenohLink
from icrl_dist.types import NULL
from tests.monitor.messages import progress, trajectory


class Out(io.TextIOWrapper):
    def __init__(self):
        super().__init__(io.BytesIO(), "utf-8", write_through=True)


def tapped(monkeypatch, tasks=(), adversaries=(), every=1, form="json", count=0):
    """What is written of 24 trajectories and some messages that are none."""
    out, ended, made = Out(), [], []
    monkeypatch.setattr(sys, "stdout", out)
    tap = TapWriter(tasks, adversaries, every, form, count, lambda: ended.append(True))
    for task in range(3):
        for variation in range(2):
            for trial in range(4):
                law = {"adversary": NULL} if variation == 0 else {}
                made.append(trajectory(f"adapt/0/{task}/{variation}/{trial}", **law))
    for first in range(0, len(made), 7):
        tap("key", monitor_messages.trajectories(made[first : first + 7], 0.0))
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


@pytest.mark.parametrize("form", ["json", "msgpack"])
def test_a_field_that_json_cannot_hold_costs_no_trajectory(monkeypatch, form):
    out = Out()
    monkeypatch.setattr(sys, "stdout", out)
    of = {"trials": [0], "returns": [1.0], "steps": [9]}
    told = [
        {
            "identity": "adapt/0/0/0",
            "adversary": {"kind": "x", "more": b"\xff\x01"},
            "kind": "a name of the message's own",
            **of,
        },
        {"identity": "adapt/0/0/1", "adversary": {}, **of},
    ]
    TapWriter((), (), 1, form, 0, lambda: None)("key", wire.encode_message("trajectories", worker="w0", variations=told))
    written = out.buffer.getvalue()
    found = [*msgpack.Unpacker(io.BytesIO(written))] if form == "msgpack" else [*map(json.loads, written.decode().splitlines())]
    assert [one["identity"] for one in found] == ["adapt/0/0/0/0", "adapt/0/0/1/0"]
    assert found[0]["adversary"]["more"] == ("ff01" if form == "json" else b"\xff\x01")


FULL = "icrl-dist: tap: standard output cannot be written: No space left on device\n"


@pytest.mark.parametrize(("full", "code", "told"), [(False, 128 + signal.SIGPIPE, ""), (True, 1, FULL)])
def test_it_ends_when_nobody_reads_it_or_nothing_can_be_written(hub, monkeypatch, capfd, full, code, told):
    """As ``icrl-dist tap | head -1`` does, without a word and with the exit code of other commands."""
    link, over = hub(), threading.Event()
    reader, writer = os.pipe()
    os.close(reader)
    if full:
        os.close(writer)
        writer = os.open("/dev/full", os.O_WRONLY)
    out = os.fdopen(writer, "w")
    monkeypatch.setattr(sys, "stdout", out)
    monkeypatch.setattr(ZenohLink, "connect", lambda *_: hub())
    monkeypatch.setattr(signal, "signal", lambda *_: None)

    def run():
        while not over.wait(0.01):
            link.publish("icrl/demo/mon/trajectories/w0", monitor_messages.trajectories([trajectory()], 0.0), droppable=True)

    running = threading.Thread(target=run)
    running.start()
    try:
        assert main(["tap", "--connect", "tcp/127.0.0.1:1"]) == code
    finally:
        over.set()
        running.join()
    out.close()  # as the interpreter does at its end
    assert capfd.readouterr().err == told


@pytest.mark.parametrize("odd", [{"every": 0}, {"count": -1}, {"tasks": (-3,)}])
def test_numbers_that_cannot_be(monkeypatch, odd):
    with pytest.raises(ConfigError, match="must be at least"):
        tapped(monkeypatch, **odd)
