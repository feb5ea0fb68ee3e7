"""The tap: filters, formats and the end of output."""

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
        self.bytes = io.BytesIO()
        super().__init__(self.bytes, "utf-8", write_through=True)


def tapped(monkeypatch, tasks=(), adversaries=(), every=1, form="json", count=0):
    """The output for 24 trajectories and some invalid messages, and how often `stop` was called."""
    out, ended, made = Out(), [], []
    monkeypatch.setattr(sys, "stdout", out)
    tap = TapWriter(tasks, adversaries, every, form, count, lambda: ended.append(True))
    for task in range(3):
        for variation in range(2):
            for trial in range(4):
                adversary = {"adversary": NULL} if variation == 0 else {}
                made.append(trajectory(f"adapt/0/{task}/{variation}/{trial}", **adversary))
    for first in range(0, len(made), 7):
        tap("key", monitor_messages.trajectories(made[first : first + 7], 0.0))
    broken = [{"identity": "x"}, {"identity": "adapt/0/0/0", "trials": [1], "returns": [], "steps": []}, 7]
    for invalid in (progress(), b"garbage", *(wire.encode_message("trajectories", variations=[one]) for one in broken)):
        tap("key", invalid)
    return out.bytes.getvalue(), len(ended)


def identities(written):
    return [json.loads(line)["identity"] for line in written.decode().splitlines()]


def test_without_filters_every_trajectory_is_written(monkeypatch):
    written, ended = tapped(monkeypatch)
    assert len(identities(written)) == 24 and not ended


def test_filters_by_task_and_by_adversary(monkeypatch):
    assert identities(tapped(monkeypatch, tasks=(2,), adversaries=("null",))[0]) == [f"adapt/0/2/0/{n}" for n in range(4)]
    assert identities(tapped(monkeypatch, tasks=(0, 1), adversaries=("1",))[0])[-1] == "adapt/0/1/1/3"
    assert identities(tapped(monkeypatch, adversaries=("dirichlet", "0"))[0]) == identities(tapped(monkeypatch)[0])


def test_every_nth_trajectory_up_to_the_count(monkeypatch):
    written, ended = tapped(monkeypatch, tasks=(1,), every=3, count=2)
    assert identities(written) == ["adapt/0/1/0/0", "adapt/0/1/0/3"] and ended == 1


def test_msgpack_output_has_one_map_a_trajectory(monkeypatch):
    written, _ = tapped(monkeypatch, tasks=(1,), form="msgpack")
    found = list(msgpack.Unpacker(io.BytesIO(written)))
    assert len(found) == 8 and found[0]["identity"] == "adapt/0/1/0/0" and found[0]["v"] == wire.VERSION


@pytest.mark.parametrize("form", ["json", "msgpack"])
def test_a_field_that_json_cannot_represent_loses_no_trajectory(monkeypatch, form):
    out = Out()
    monkeypatch.setattr(sys, "stdout", out)
    columns = {"trials": [0], "returns": [1.0], "steps": [9]}
    entries = [
        {
            "identity": "adapt/0/0/0",
            "adversary": {"kind": "x", "more": b"\xff\x01"},
            "kind": "a field named like one of the message",
            **columns,
        },
        {"identity": "adapt/0/0/1", "adversary": {}, **columns},
    ]
    TapWriter((), (), 1, form, 0, lambda: None)("key", wire.encode_message("trajectories", worker="w0", variations=entries))
    written = out.bytes.getvalue()
    found = [*msgpack.Unpacker(io.BytesIO(written))] if form == "msgpack" else [*map(json.loads, written.decode().splitlines())]
    assert [one["identity"] for one in found] == ["adapt/0/0/0/0", "adapt/0/0/1/0"]
    assert found[0]["adversary"]["more"] == ("ff01" if form == "json" else b"\xff\x01")


FULL = "icrl-dist: tap: standard output cannot be written: No space left on device\n"


@pytest.mark.parametrize(("full", "code", "message"), [(False, 128 + signal.SIGPIPE, ""), (True, 1, FULL)])
def test_the_tap_ends_when_its_reader_is_gone_or_writing_fails(hub, monkeypatch, capfd, full, code, message):
    """A closed pipe, as in ``icrl-dist tap | head -1``, gives no message and the exit code of other commands."""
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
    out.close()  # as the interpreter does on exit
    assert capfd.readouterr().err == message


@pytest.mark.parametrize("invalid", [{"every": 0}, {"count": -1}, {"tasks": (-3,)}])
def test_numbers_out_of_range_are_refused(monkeypatch, invalid):
    with pytest.raises(ConfigError, match="must be at least"):
        tapped(monkeypatch, **invalid)


def test_a_line_is_printable_json_whatever_a_worker_sends(monkeypatch):
    out = Out()
    monkeypatch.setattr(sys, "stdout", out)
    columns = {"trials": [0], "steps": [9], "adversary": {"kind": "\x1b]52;c;x\x07\n[/x]"}}
    entries = [
        {"identity": f"adapt/0/0/{n}", "returns": [value], **columns}
        for n, value in enumerate((float("nan"), 1.0, float("inf")))
    ]
    tap = TapWriter((), (), 1, "json", 0, lambda: None)
    tap("key", wire.encode_message("trajectories", worker="\u202e\x9b", variations=entries))
    lines = out.bytes.getvalue().decode().splitlines()
    assert [json.loads(line, parse_constant=pytest.fail)["identity"] for line in lines] == ["adapt/0/0/1/0"]
    assert all(line.isascii() and line.isprintable() for line in lines)
