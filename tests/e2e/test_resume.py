"""A run that is killed several times, and resumed with another number of workers, gives the same bytes."""

import os
import signal
import threading

import psutil
import pytest

from icrl_dist.storage.checkpoint import partial_file
from icrl_dist.stream import monitor_messages, wire
from icrl_dist.stream.zenoh_link import ZenohLink
from learner import checkpoints
from tests.e2e.training import (
    NO_RESTARTS,
    SMOKE,
    descendants_of,
    endpoint_of,
    equal,
    finish,
    kill_the_tree,
    result_of,
    start,
    wait_for,
    workers_of,
)


def act_when(folder, reached, act):
    """Call ``act`` at the first monitor message that ``reached`` accepts."""
    happened = threading.Event()

    def receive(key, payload):
        if reached(*wire.decode_message(payload)):
            happened.set()

    with ZenohLink.connect(endpoint_of(folder), timeout_s=30) as link:
        link.subscribe(f"icrl/{folder.name}/mon/**", receive)
        assert happened.wait(400)
        act()


def kill_when(process, folder, reached):
    """Kill the run and all its processes at the first monitor message that ``reached`` accepts."""
    act_when(folder, reached, lambda: kill_the_tree(process))
    (folder / "endpoint").unlink(missing_ok=True)  # the learner may have removed it while it ended


def collecting(phase, count):
    """A condition that holds once ``count`` trajectories of a phase were sent."""
    seen = set[str]()

    def reached(kind, fields):
        if kind == "trajectories":
            seen.update(one["identity"] for one in monitor_messages.rows(fields) if one["identity"].startswith(phase))
        return len(seen) >= count

    return reached


def fitting(kind, fields):
    return kind == "learner" and fields["stage"] == "fit" and fields["phase"] == "pretrain" and fields["step"] > 0


@pytest.mark.timeout(900)
def test_killing_the_command_or_all_processes_changes_nothing_and_leaves_no_process(reference, tmp_path):
    folder = tmp_path / "killed"
    run = ["train", *SMOKE, *NO_RESTARTS, "--out", folder]
    process = start(*run, "--actors", "1", start_new_session=True)
    family = list[psutil.Process]()

    def kill_the_command():
        family[:] = descendants_of(process)  # Ray's own processes included
        os.kill(process.pid, signal.SIGKILL)
        finish(process)
        _, alive = psutil.wait_procs(family, timeout=30)
        assert not [p.cmdline() for p in alive], "processes without a parent ended by themselves"

    act_when(folder, fitting, kill_the_command)
    assert len(family) >= 5 and checkpoints.read_manifest(partial_file(folder))["step"] > 0
    assert not (folder / "result.json").exists()
    process = start(*run, "--actors", "1", "--resume", start_new_session=True)
    kill_when(process, folder, collecting("adapt/0/", 30))
    assert not (folder / "result.json").exists()
    process = start(*run, "--resume", start_new_session=True)

    def kill_the_command_with_two_workers():
        wait_for(lambda: len(workers_of(process)) == 2, "both workers")
        os.kill(process.pid, signal.SIGKILL)
        finish(process)

    act_when(folder, collecting("adapt/1/", 1), kill_the_command_with_two_workers)
    again = start(*run, "--resume")  # at once: the old learner may still run
    output = finish(again)
    assert again.returncode == 0, output
    assert equal(result_of(folder), reference)
