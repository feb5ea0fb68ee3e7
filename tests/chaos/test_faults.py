"""The parts of fault injection: the schedule, the verdict, the proxy, the small disk, and what a full disk reports."""

import contextlib
import errno
import itertools
import json
import os
import select
import socket

import pytest

from icrl_dist.chaos import disk, proxy, schedule
from icrl_dist.chaos.outcome import Outcome, verdict
from icrl_dist.cli import doctor, main
from icrl_dist.config.run import ConfigError, load, override
from icrl_dist.launch.train import prepare
from icrl_dist.storage.files import StoreError
from icrl_dist.telemetry.metrics import Metrics
from learner import __main__ as learner


@pytest.mark.parametrize(("landed", "equal"), [(True, True), (True, False), (False, True), (False, False)])
def test_the_verdict_needs_a_landed_fault_and_equal_digests(landed, equal):
    outcome = Outcome(0, "kill-tree", "adapt/0", landed, "", equal)
    assert outcome.ok is (landed and equal)
    assert ("every digest equals" in verdict([outcome])) is outcome.ok


def test_the_schedule_is_a_function_of_the_seed():
    run = load("smoke")
    keys = list(itertools.product(range(20), schedule.FAULTS, (0, 1)))
    drawn = {key: schedule.draw(run, *key) for key in keys}
    assert drawn == {key: schedule.draw(run, *key) for key in keys}
    assert len(set(drawn.values())) == len(drawn)
    assert all(0 < strike.after <= strike.of / 2 + 1 for strike in drawn.values())
    for fault in schedule.FAULTS:
        phases = {strike.name for key, strike in drawn.items() if key[1] == fault}
        assert phases == {"adapt/0", "adapt/1"} | ({"pretrain/0"} if fault not in ("flip-byte", "flip-checkpoint") else set())
    assert {strike.fit for strike in drawn.values()} == {False, True}


def test_a_fault_that_cannot_strike_the_run_is_refused():
    with pytest.raises(ConfigError, match="--faults flip-byte: dpt has one phase"):
        schedule.draw(override(load("smoke"), ["method=dpt"], "test"), 0, "flip-byte")


def test_a_cut_proxy_holds_data_back_and_loses_none():
    with contextlib.ExitStack() as stack:
        server = stack.enter_context(socket.create_server(("127.0.0.1", 0)))
        cable = stack.enter_context(proxy.Proxy(server.getsockname))
        near = stack.enter_context(socket.create_connection(("127.0.0.1", cable.port), timeout=10))
        far = stack.enter_context(server.accept()[0])
        near.sendall(b"one")
        assert far.recv(8) == b"one"
        cable.cut()
        near.sendall(b"two")
        assert not select.select([far], [], [], 0.3)[0]
        with socket.create_connection(("127.0.0.1", cable.port), timeout=10):
            server.settimeout(0.3)
            with pytest.raises(TimeoutError):
                server.accept()
            cable.mend()
            server.settimeout(10)
            server.accept()[0].close()
        far.settimeout(10)
        assert far.recv(8) == b"two"
        near.shutdown(socket.SHUT_WR)
        assert far.recv(8) == b""


def test_a_full_disk_can_be_enlarged_and_its_files_are_kept(tmp_path):
    try:
        mounted = disk.Disk(tmp_path / "disk", 8 * disk.PAGE)
    except disk.NoDisk as error:
        pytest.skip(f"this node does not allow a mount: {error}")
    with mounted:
        with pytest.raises(OSError) as caught:
            (mounted.view / "large").write_bytes(bytes(9 * disk.PAGE))
        assert caught.value.errno == errno.ENOSPC
        mounted.grow(16 * disk.PAGE)
        (mounted.view / "large").write_bytes(bytes(9 * disk.PAGE))
        assert disk.allocated(mounted.view) == 9 * disk.PAGE
    assert not os.path.ismount(tmp_path / "disk")
    assert (tmp_path / "disk" / "large").read_bytes() == bytes(9 * disk.PAGE)


def test_metrics_on_a_full_disk_name_the_remedy(tmp_path):
    (tmp_path / "metrics.jsonl").symlink_to("/dev/full")
    metrics = Metrics(tmp_path, tensorboard=False)
    remedy = r"metrics.jsonl: could not be written \(No space left on device\): free space, then use --resume"
    with pytest.raises(StoreError, match=remedy):
        metrics.write(1, "fit", loss=1.0)
    metrics.close()


def test_a_full_disk_is_reported_in_one_line_with_the_remedy(capsys, monkeypatch):
    def full(*_):
        raise OSError(errno.ENOSPC, "No space left on device", "runs/smoke/report/adaptation.png")

    monkeypatch.setitem(main.COMMANDS, "doctor", (doctor.DoctorArguments, full))
    assert main.main(["doctor"]) == 1
    (line,) = capsys.readouterr().err.splitlines()
    assert "adaptation.png: could not be written" in line and "free space, then use --resume" in line


def test_a_learner_reports_a_full_disk_with_the_remedy_and_other_errors_with_a_traceback(capfd, monkeypatch, tmp_path):
    def fails(code):
        monkeypatch.setattr(learner, "_serve", lambda *_: (_ for _ in ()).throw(OSError(code, os.strerror(code), "endpoint")))
        return learner.main()

    monkeypatch.setattr("sys.argv", ["learner", str(tmp_path), "--endpoint", "tcp/127.0.0.1:0"])
    assert fails(errno.ENOSPC) == learner.FAILED
    event = json.loads(capfd.readouterr().out)
    assert event["event"] == "error" and "endpoint: could not be written" in event["text"] and "--resume" in event["text"]
    with pytest.raises(OSError, match="Bad file descriptor"):
        fails(errno.EBADF)


def test_resuming_does_not_rewrite_the_run_file(tmp_path):
    run, folder = load("smoke"), tmp_path / "run"
    prepare(run, folder, resume=False, overwrite=False)
    (folder / "run.toml").chmod(0o444)
    before = (folder / "run.toml").stat()
    prepare(run, folder, resume=True, overwrite=False)
    after = (folder / "run.toml").stat()
    assert (after.st_mtime_ns, after.st_ino) == (before.st_mtime_ns, before.st_ino)
