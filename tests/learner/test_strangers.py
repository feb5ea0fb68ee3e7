"""The worker API against a client that holds a worker's key and no manners: what it keeps is bounded, and it goes on."""

import dataclasses
import gc
import logging
import random
import time
import tracemalloc
from typing import Any

import msgpack
import pytest

from icrl_dist.stream import wire
from icrl_dist.stream.link import Refused, Unanswered
from icrl_dist.telemetry import budget, crash_reports
from learner import known_workers, worker_api
from learner.broadcast import Broadcast
from tests.learner.test_worker_api import COUNTS, KEYS, RECORD, Server, records
from tests.stream.examples import weights

MB = 1 << 20
HOSTILE_NAMES = ["", ".", "..", "../w0", "w/0", "w\x000", "\x1b[2J", "[/x]", "w" * 100_000, "\u202ew0", "w0\n"]


@pytest.fixture
def server(small_run, tmp_path, hub, monkeypatch):
    server = Server(small_run, tmp_path, hub, monkeypatch)
    yield server
    server.worker_api.close()


def attempt(server, payload):
    """Send any bytes as a request; returns the refusal, or None."""
    try:
        server.link.request(KEYS.work, payload, timeout_s=10.0)
    except Refused as error:
        return str(error)
    return None


def goes_on(server):
    return server.ask("w0")[0] == "job" and server.worker_api.known.counters["w0"]["episodes"] == 0


def test_a_crash_record_is_for_a_job_that_its_worker_holds(server):
    server.ask("w0")
    for worker, job in (("stranger", 0), ("w0", 1), ("stranger", 2)):
        assert server.fail(worker, server.jobs[job]) == ("noted", {})
    assert not records(server) and not server.events
    server.fail("w0", server.jobs[0])
    assert list(records(server)) == ["w0-1.json"]
    server.fail("w0", server.jobs[0])
    assert list(records(server)) == ["w0-1.json"], "the job was released with the first report"


def test_large_records_and_fields_are_refused_and_nothing_of_them_is_kept(server):
    server.ask("w0")
    big = {"x": bytes(15 * MB)}
    record = {**RECORD, "worker": "w0"}
    messages: list[tuple[str, dict[str, Any]]] = [
        ("ask", {**COUNTS, **big}),
        ("note", {"text": "hello", **big}),
        ("failed", {"job": list(server.jobs[0].name), "file": "", "record": {**record, **big}}),
        ("failed", {"job": list(server.jobs[0].name), "file": "", "record": {**record, "exception": "x" * 60_000}}),
        ("failed", {"job": list(server.jobs[0].name), "file": "", "record": {**record, "lines": ["x" * 60_000] * 16}}),
    ]
    tracemalloc.start()
    try:
        before, _ = tracemalloc.get_traced_memory()
        for n in range(40):
            kind, fields = messages[n % len(messages)]
            assert "schema" in (attempt(server, wire.encode_message(kind, worker=f"w{n}", **fields)) or "")
            server.link.publish(KEYS.monitor("worker/w0"), wire.encode_message("worker", worker="w0", **COUNTS, **big), True)
        gc.collect()
        grown = tracemalloc.get_traced_memory()[0] - before
    finally:
        tracemalloc.stop()
    assert grown < 60 * MB, "of 1,200 MB: only unread heartbeats, of which a mailbox keeps 32 MB"
    assert not (server.folder / "crashes").exists() and goes_on(server)


def test_names_of_workers_are_checked_before_they_reach_a_file_or_a_view(server, hub):
    for name in HOSTILE_NAMES:
        with pytest.raises(Refused, match="schema"):
            server.ask(name)
    link = hub()
    for name in ("..", "\x7f", "[/x]", "w" * 100):
        link._alive.add(KEYS.alive("w0").replace("w0", name))
        server.worker_api._on_liveliness(name, True)
        server.worker_api._on_liveliness(name, False)
    assert not server.events and not server.worker_api.known.alive and goes_on(server)


def test_thousands_of_names_leave_room_for_the_workers_that_are_there(server, monkeypatch):
    monkeypatch.setattr(known_workers, "MAX_WORKERS", 50)
    monkeypatch.setattr(worker_api, "MAX_WORKERS", 50)
    server.worker_api._on_liveliness("w0", True)
    server.ask("w0")
    for n in range(300):
        server.ask(f"stranger-{n}")
        server.worker_api._on_liveliness(f"token-{n}", True)
        if n >= 30:
            server.worker_api._on_liveliness(f"token-{n - 30}", False)
    known = server.worker_api.known
    assert len({*known.alive, *known.counters, *known.last_message}) <= 50
    assert known.alive["w0"] and "w0" in known.counters and goes_on(server)


def test_the_alerts_about_silence_are_limited_to_workers_that_have_connected(server, monkeypatch):
    monkeypatch.setattr(known_workers, "_MAX_SILENT", 4)
    for n in range(20):
        server.ask(f"stranger-{n}")
        server.worker_api._on_liveliness(f"w{n}", True)
        server.ask(f"w{n}")
    assert list(server.worker_api.known.totals["silent"]) == ["w0", "w1", "w2", "w3"]
    assert len(server.worker_api.known.totals["waited"]) == 20


def test_what_workers_report_is_limited_in_number(server, monkeypatch):
    monkeypatch.setattr(crash_reports, "MAX_FILES", 7)
    monkeypatch.setattr(server.worker_api, "_budget", budget.Budget(20, 0.0))
    for n in range(100):
        server.request("note", "w0", text=f"note {n}")
    assert len(server.events) == 20
    monkeypatch.setattr(server.worker_api, "_budget", budget.Budget(1000, 0.0))
    server.worker_api._budget.left_out = 80
    for n in range(10):
        server.worker_api._on_liveliness(f"w{n}", True)
        server.worker_api._on_liveliness(f"w{n}", False)
    crashes = server.wait("crash", 10)
    assert sum("the limit" in event["text"] for event in crashes) == 3 and len(records(server)) == 7
    assert sum("80 more of these were left out" in event.get("text", "") for event in server.events) == 1


DEEP = b"\x81\xa1v" + b"\x91" * 100_000 + b"\xc0"


def test_any_bytes_are_refused_without_a_traceback_in_the_log(server, caplog):
    caplog.set_level(logging.INFO)
    whole, rng = wire.encode_message("ask", worker="w0", **COUNTS), random.Random(1)
    bad = [b"", b"\xc1", DEEP, b"\xdd\xff\xff\xff\xff", whole[:-1], msgpack.packb([1])]
    bad += [whole.replace(b"w0", b"\xff\xfe"), msgpack.packb({"v": 2, "kind": "ask", "worker": 2**63})]
    bad += [bytes(rng.randrange(256) if rng.random() < 0.1 else byte for byte in whole) for _ in range(200)]
    for payload in bad:
        attempt(server, payload)
        server.worker_api._on_heartbeat(KEYS.monitor("worker/w0"), payload)
    for record in caplog.records:
        assert record.exc_info is None and len(record.getMessage()) < 1000
    assert server.ask("w1")[0] == "job"


def test_a_heartbeat_counts_for_the_worker_in_its_key(server):
    message = wire.encode_message("worker", worker="w1", **COUNTS)
    server.link.publish(KEYS.monitor("worker/w0"), message, droppable=True)
    server.link.publish(KEYS.monitor("worker/w1"), message, droppable=True)
    deadline = time.monotonic() + 30
    while "w1" not in server.worker_api.known.counters:
        assert time.monotonic() < deadline
        time.sleep(0.01)
    assert "w0" not in server.worker_api.known.counters


def test_log_lines_are_printable_and_few_of_each_kind(tmp_path):
    logger, file = logging.Logger("stranger"), tmp_path / "log"
    handler, lines = logging.FileHandler(file), budget.LogLines(burst=5, per_s=0.0)
    handler.setFormatter(lines)
    handler.addFilter(lines)
    logger.addHandler(handler)
    for n in range(1000):
        logger.warning("refused %s", f"\x1b]52;c;x\x07 {n}")
    logger.warning("another line of the code")
    handler.close()
    written = file.read_text()
    assert written.replace("\n", "").isprintable() and written.count("refused") == 5 and "another line" in written


def test_requests_for_weights_are_checked(small_run, hub):
    loaded = list[int]()

    def older(version):
        loaded.append(version)
        raise AssertionError("no such version")

    broadcast = Broadcast(hub(), KEYS, older)
    broadcast.publish(dataclasses.replace(weights(), version=3))
    client = hub()
    for version in (float("inf"), float("nan"), "9" * 60_000, True, None, [1], -2, 2**63):
        with pytest.raises((Refused, Unanswered), match=r"schema|busy"):
            client.request(KEYS.weights_latest, wire.encode_message("weights", version=version), timeout_s=10.0)
    assert not loaded
