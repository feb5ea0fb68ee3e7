"""A complete run: a learner process, two Ray workers, Zenoh over loopback, two ICAA rounds."""

import contextlib
import json
import os
import re
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import psutil
import pytest

from icrl_dist.agent.loading import load_agent
from icrl_dist.config.run import load
from icrl_dist.methods import registry as methods
from icrl_dist.problems.darkroom.problem import DarkRoomProblem
from icrl_dist.storage.checkpoint import version_file
from icrl_dist.storage.dataset import Dataset
from icrl_dist.stream.link import Refused
from icrl_dist.telemetry.processes import is_learner
from learner import checkpoints
from tests.e2e.training import (
    CLI,
    NO_RESTARTS,
    SMALLER,
    SMOKE,
    descendants_of,
    endpoint_of,
    equal,
    finish,
    on_first_adapt_trajectory,
    result_of,
    start,
    wait_for,
    workers_of,
)
from tests.optional import known


@pytest.fixture(scope="module")
def undisturbed(tmp_path_factory):
    """One run through Ray and Zenoh, observed by ``tap`` and by the script of docs/tap.md."""
    folder = tmp_path_factory.mktemp("runs") / "smoke"
    process = start("train", *SMALLER, *NO_RESTARTS, "--out", folder, "--json")
    endpoint = endpoint_of(folder)
    page = (Path(__file__).parents[2] / "docs" / "tap.md").read_text()
    script = known(re.search(r"```python\n(.*?)```", page, re.DOTALL))
    commands = {
        "tap": [*CLI, "tap", "--connect", endpoint],
        "documented": [sys.executable, "-c", script.group(1), endpoint, folder.name],
    }
    outputs = {name: folder.parent / name for name in commands}
    with contextlib.ExitStack() as stack:
        # Into files: a full pipe would block the listener.
        files = {name: stack.enter_context(outputs[name].open("w")) for name in commands}
        listeners = [subprocess.Popen(commands[name], stdout=files[name], stderr=subprocess.DEVNULL) for name in commands]
        output = finish(process)
        for listener in listeners:
            listener.send_signal(signal.SIGINT)
            try:
                listener.wait(timeout=60)
            finally:
                listener.kill()
                listener.wait()
    lines = {name: file.read_text().splitlines() for name, file in outputs.items()}
    assert process.returncode == 0, output
    return folder, output, lines


def test_every_trajectory_arrived_once_with_the_policy_version_of_its_round(undisturbed):
    folder, _, _ = undisturbed
    run = load(str(folder / "run.toml"))
    method = methods.of(run)
    wanted = {i for phase in method.phases(run) for job in method.ask(run, phase) for i in job.identities()}
    store = Dataset(folder / "dataset")
    trajectories = [store.read(row.identity) for row in store.index]
    store.close()
    assert {t.identity for t in trajectories} == wanted and len(trajectories) == len(wanted)
    assert {t.worker for t in trajectories} == {"w0", "w1"}
    digests = [checkpoints.read_manifest(version_file(folder, version))["weights_digest"] for version in range(2)]
    for t in trajectories:
        if t.identity.stage == "adapt":
            assert (t.policy_version, t.weights_digest) == (t.identity.round, digests[t.identity.round])
    assert {t.policy_version for t in trajectories} == {-1, 0, 1}


def test_ray_and_inline_give_the_same_bytes(undisturbed, reference):
    assert equal(result_of(undisturbed[0]), reference)


def test_the_result_is_on_the_last_line_and_in_the_folder(undisturbed):
    folder, output, _ = undisturbed
    result = json.loads(output.splitlines()[-1])
    assert result["rows"] == result_of(folder)["rows"]
    assert {(row["agent"], row["p"]) for row in result["rows"]} == {
        (agent, p)
        for agent in ("T^2 (icaa)", "T^0", "random", *DarkRoomProblem.agent_names.values(), "oracle")
        for p in (0.0, 0.2)
    }
    assert Path(result["figure"]).read_bytes().startswith(b"\x89PNG")


def test_the_last_version_is_calibrated(undisturbed):
    folder, output, _ = undisturbed
    assert set(json.loads(output.splitlines()[-1])["surprise"]) == {"0", "0.2"}
    np.testing.assert_array_equal(load_agent(folder).surprise, [0.0])


def test_acting_with_zeroed_weights_changes_the_actions(undisturbed):
    def actions(zero):
        agent = load_agent(undisturbed[0], seed=1)
        if zero:
            for parameter in agent.model.parameters():
                parameter.data.zero_()
        agent.reset_context(batch=64)
        return agent.act(np.tile([[1.0, 2.0]], (64, 1)))

    assert (actions(zero=False) == actions(zero=False)).all()
    assert (actions(zero=False) != actions(zero=True)).any()


def test_tap_and_the_documented_script_print_one_line_per_trajectory(undisturbed):
    folder, _, lines = undisturbed
    store = Dataset(folder / "dataset")
    stored = {str(row.identity) for row in store.index}
    store.close()
    for name in ("tap", "documented"):
        messages = [json.loads(line) for line in lines[name]]
        identities = [fields["identity"] for fields in messages]
        assert identities and set(identities) <= stored, name
        # Both connected before the first round and were fast enough to receive the whole last round.
        assert sum(i.startswith("adapt/1") for i in identities) == 14 * (20 + 1), name


def test_evaluate_prints_returns_and_those_of_the_oracle(undisturbed):
    process = start("evaluate", undisturbed[0], "--episodes", "2", "--seeds", "2", "--p", "0", "0.4", "--json")
    output = finish(process)
    assert process.returncode == 0, output
    rows = json.loads(output.splitlines()[-1])["rows"]
    agents = 4 + len(DarkRoomProblem.agent_names)
    assert [row["p"] for row in rows] == [0.0] * agents + [0.4] * agents
    assert all(len(row["episodes"]) == 2 for row in rows)
    assert next(row for row in rows if row["agent"] == "oracle")["episodes"] == [9.0, 9.0]


def test_killing_the_learner_and_then_a_worker_changes_nothing(reference, tmp_path):
    folder = tmp_path / "killed"
    process = start("train", *SMOKE, "--out", folder)

    def kill():
        (learner,) = [p for p in descendants_of(process) if is_learner(p)]
        (folder / "endpoint").unlink()
        learner.kill()

    with on_first_adapt_trajectory(folder, kill) as killed:
        assert killed.wait(300)
    with on_first_adapt_trajectory(folder, lambda: os.kill(workers_of(process)[0].pid, signal.SIGKILL), 1) as killed:
        assert killed.wait(300)
        with pytest.raises(Refused, match="not-msgpack"):
            killed.link.request(f"icrl/{folder.name}/data", b"\xc1garbage", timeout_s=60)
    output = finish(process)
    assert process.returncode == 0, output
    assert "the learner died (exit code -9)" in output
    assert re.search(r"worker w\d died", output) and "starting it again" in output
    result = result_of(folder)
    assert equal(result, reference)
    assert result["learner_deaths"] == 1 <= result["worker_deaths"]
    assert result["drops"]["not-msgpack"] == 1


def raylets_of(process):
    """Ray's node process, if it has started."""
    found = []
    for one in descendants_of(process):
        with contextlib.suppress(psutil.NoSuchProcess):
            found += [one] * (one.name() == "raylet")
    return found


def test_sigterm_leaves_a_checkpoint_and_no_process_and_resume_continues(reference, tmp_path):
    folder = tmp_path / "terminated"
    process = start("train", *SMOKE, *NO_RESTARTS, "--actors", "1", "--out", folder)
    family, raylets = [], []

    def terminate():
        family.extend(descendants_of(process))
        raylets.extend(raylets_of(process))
        process.terminate()

    with on_first_adapt_trajectory(folder, terminate) as terminated:
        assert terminated.wait(300)
    (raylet,) = raylets
    raylet.wait(120)
    process.terminate()  # again, while the command ends Ray's other processes: without effect
    output = finish(process)
    assert process.returncode == 130, output
    assert "SIGTERM" not in output and "--resume" in output
    _, alive = psutil.wait_procs(family, timeout=60)
    assert not [p.cmdline() for p in alive]
    assert (folder / "checkpoints" / "version-0000.npz").exists()
    again = start("train", *SMOKE, *NO_RESTARTS, "--engine", "inline", "--out", folder, "--resume")  # gives the same bytes
    output = finish(again)
    assert again.returncode == 0, output
    assert equal(result_of(folder), reference)


def test_sigterm_while_ray_starts_has_the_effect_of_ctrl_c(tmp_path):
    process = start("train", *SMOKE, *NO_RESTARTS, "--actors", "1", "--out", tmp_path / "terminated")
    family = wait_for(lambda: raylets_of(process), "the start of Ray") + descendants_of(process)
    process.terminate()
    output = finish(process)
    assert process.returncode == 130 and output.splitlines()[-1].startswith("interrupted; "), output
    _, alive = psutil.wait_procs(family, timeout=60)
    assert not [p.cmdline() for p in alive]
