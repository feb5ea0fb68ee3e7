"""Everything killed at once, and any number of workers: the same bytes."""

import os
import signal
import threading

import psutil
import pytest

from icrl_dist.stream import wire
from icrl_dist.stream.zenoh_link import ZenohLink
from tests.e2e.training import LONGER, endpoint_of, equal, finish, result_of, start, wait_for


def kill_the_tree(process):
    """SIGKILL to the command and to everything that it started, Ray's own processes included."""
    family = [psutil.Process(process.pid), *psutil.Process(process.pid).children(recursive=True)]
    for member in family:
        with_it = [m for m in family if m.is_running()]
        assert with_it
        try:
            member.kill()
        except psutil.NoSuchProcess:
            continue
    process.wait(timeout=30)
    _, alive = psutil.wait_procs(family, timeout=15)
    assert not alive


@pytest.mark.parametrize(
    "moment",
    [("collect", "pretrain", 0, 60), ("fit", "pretrain", 0, 20), ("collect", "adapt", 1, 50)],
    ids=["D^0 is collected", "T^0 is fitted", "round 1 is collected"],
)
def test_kill_9_of_the_whole_tree_and_resume_changes_nothing(longer, tmp_path, moment):
    stage, phase, round_, step = moment
    folder = tmp_path / "killed"
    process = start("train", "smoke", *LONGER, "--out", folder, start_new_session=True)
    reached = threading.Event()

    def hear(key, payload):
        kind, fields = wire.decode_message(payload)
        if kind == "trajectory" and stage == "collect" and fields["identity"].startswith(f"{phase}/{round_}/"):
            seen.add(fields["identity"])
            if len(seen) >= step:
                reached.set()
        if kind == "learner" and stage == "fit" and fields["stage"] == "fit" and fields["phase"] == phase:
            reached.set()

    seen = set()
    with ZenohLink.connect(endpoint_of(folder), timeout_s=30) as link:
        link.subscribe(f"icrl/{folder.name}/mon/**", hear)
        assert reached.wait(90)
        kill_the_tree(process)
    assert not (folder / "result.json").exists()
    again = start("train", "smoke", *LONGER, "--out", folder, "--resume")
    output = finish(again)
    assert again.returncode == 0, output
    assert equal(result_of(folder), longer)


def test_kill_9_of_the_command_alone_leaves_nothing_behind_and_resume_goes_on(longer, tmp_path):
    folder = tmp_path / "orphaned"
    process = start("train", "smoke", *LONGER, "--out", folder, start_new_session=True)
    endpoint_of(folder)
    wait_for(lambda: list((folder / "dataset").glob("segment-*")), "the first trajectory")
    family = psutil.Process(process.pid).children(recursive=True)
    os.kill(process.pid, signal.SIGKILL)
    process.wait(timeout=30)
    again = start("train", "smoke", *LONGER, "--out", folder, "--resume")  # at once: the old learner may still be there
    output = finish(again)
    assert again.returncode == 0, output
    assert equal(result_of(folder), longer)
    _, alive = psutil.wait_procs(family, timeout=60)
    assert not [p.cmdline() for p in alive]


@pytest.mark.parametrize("workers", [1, 4])
def test_one_and_four_workers_end_with_the_bytes_of_none(longer, tmp_path, workers):
    folder = tmp_path / f"workers-{workers}"
    process = start("train", "smoke", *LONGER, "--out", folder, "--actors", workers, "--oversubscribe")
    output = finish(process)
    assert process.returncode == 0, output
    assert equal(result_of(folder), longer)
    assert result_of(folder)["lag"].keys() == {"0"}
