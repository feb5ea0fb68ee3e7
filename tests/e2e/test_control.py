"""A continuous game through Ray and Zenoh: experts made, killed, reused, and learned from."""

import json
import signal

import numpy as np
import psutil
import pytest

from icrl_dist.agent.loading import load_agent
from icrl_dist.storage.dataset import Dataset
from icrl_dist.stream import wire
from icrl_dist.stream.zenoh_link import ZenohLink
from tests.e2e.training import endpoint_of, equal, finish, result_of, start, wait_for

SAC = {"hidden": "[16]", "batch": 16, "random-steps": 100, "warmup": 100, "steps": 500}
TINY = [
    *(word for name, value in SAC.items() for word in ("--set", f"sac.{name.replace('-', '_')}={value}")),
    *("--control.horizon", "50", "--control.test-tasks", "2", "--stream.job-tasks", "2"),
    *("--pretrain.contexts", "32", "--pretrain.queries", "8", "--pretrain.steps", "15", "--model.width", "16"),
    *("--icaa.trials", "3", "--icaa.context-trials", "1", "--icaa.steps", "8", "--icaa.label-trials", "later"),
    *("--evaluate.episodes", "2", "--evaluate.seeds", "1", "--learner.threads", "1"),
]


def train(name, folder, cache, *arguments):
    return start("train", name, *TINY, "--sac.cache", cache, "--out", folder, *arguments)


@pytest.fixture(scope="module")
def inline(tmp_path_factory):
    """ICAA on reacher in one process: what a run through Ray must equal."""
    folder = tmp_path_factory.mktemp("control")
    process = train("dmc-reacher-easy-laptop", folder / "inline", folder / "cache", "--method", "icaa", "--engine", "inline")
    output = finish(process)
    assert process.returncode == 0, output
    return folder, output


def test_returns_stand_beside_the_experts_and_random_ones(inline):
    folder, output = inline
    result = result_of(folder / "inline")
    assert {(row["agent"], row["p"]) for row in result["rows"]} == {
        (agent, p) for agent in ("T^1 (icaa)", "T^0", "random", "SAC expert") for p in (0.0, 1.0)
    }
    assert all(row["optimum"] is None and len(row["episodes"]) == 2 for row in result["rows"])
    assert "of SAC expert" in output and "4 training tasks of dmc-reacher-easy" in output
    agent = load_agent(folder / "inline", seed=0)
    assert agent.manifest["problem"] == "dmc-reacher-easy" and len(agent.manifest["train_tasks"]) == 4
    action = agent.act(np.zeros((1, 6)))
    assert action.shape == (1, 2) and action.dtype == np.float32 and np.abs(action).max() <= 1
    agent.observe(np.zeros((1, 6)), action, [1.0], np.zeros((1, 6)), [False])
    assert agent.surprise.shape == (1,)
    store = Dataset(folder / "inline" / "dataset", readonly=True)
    origins = {t.origin for key in store.variations("pretrain", 0) for t in store.trials(key)}
    adapted = [t for key in store.variations("adapt", 0) for t in store.trials(key)]
    store.close()
    assert origins == {"expert"} and {t.origin for t in adapted} == {"none"} and len(adapted) == 4 * 2 * 4


def test_ray_ends_with_the_same_bytes_though_a_worker_is_killed_while_its_experts_train(inline, tmp_path):
    folder, heartbeats = tmp_path / "ray", []
    process = train("dmc-reacher-easy-laptop", folder, tmp_path / "cache", "--method", "icaa", "--json")
    with ZenohLink.connect(endpoint_of(folder), timeout_s=30) as link:
        link.subscribe(f"icrl/{folder.name}/mon/worker/**", lambda _, data: heartbeats.append(wire.decode_message(data)[1]))
        pid = wait_for(
            lambda: next((h["pid"] for h in list(heartbeats) if "experts at" in h["doing"]), None), "experts training"
        )
    psutil.Process(pid).send_signal(signal.SIGKILL)
    output = finish(process)
    assert process.returncode == 0, output
    result = json.loads(output.splitlines()[-1])
    assert result["worker_deaths"] == 1 and equal(result, result_of(inline[0] / "inline"))


def test_experts_alone_are_kept_for_every_later_run(tmp_path):
    results, saved = [], []
    for number in range(2):
        process = train("experts-dmc-cartpole-balance-laptop", tmp_path / f"{number}", tmp_path / "cache", "--engine", "inline")
        output = finish(process)
        assert process.returncode == 0 and "SAC experts: return" in output, output
        results.append(result_of(tmp_path / f"{number}"))
        saved.append([line for line in output.splitlines() if "experts from the cache" in line])
    assert saved[0] == [] and len(saved[1]) == 2
    assert all("4 experts from the cache, 2,000 steps of SAC saved" in line for line in saved[1])
    rows = results[0]["experts"]
    assert [row["adversary"] for row in rows] == ["null", "network"] * 4 and all(len(row["returns"]) == 2 for row in rows)
    assert results[1]["experts"] == rows and equal(*results) and results[0]["trajectories"] == 32
