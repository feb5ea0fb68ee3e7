"""A small sweep as users run it: killed, interrupted, continued, and done again."""

import contextlib
import json
import os
import signal
import threading
import time

import psutil
import pyarrow.parquet as pq
import pytest

from icrl_dist.cli import main
from icrl_dist.sweeps import file, one, plan, rows, state
from icrl_dist.sweeps.one import Work

TEXT = """
run = "smoke"
seeds = [0]
split_seed = "seed"
[settings.override]
[methods.icaa]
method = "icaa"
[methods.exact]
method = "exact"
[evaluations.online]
episodes = 2
seeds = 1
rounds = true
[evaluations.attack]
suite = "attack"
episodes = 1
seeds = 1
draws = 2
[evaluations.offline]
suite = "offline"
seeds = 1
"""


def when(condition, action):
    """Call ``action`` as soon as ``condition()`` is true; a thread that ends with the test."""

    def wait():
        deadline = time.monotonic() + 60
        while not condition() and time.monotonic() < deadline:
            time.sleep(0.002)
        with contextlib.suppress(psutil.NoSuchProcess):
            action()

    thread = threading.Thread(target=wait, daemon=True)
    thread.start()
    return thread


def children():
    found = []
    for child in psutil.Process().children():
        with contextlib.suppress(psutil.NoSuchProcess):  # it has ended, as that of another test
            if "icrl_dist.sweeps.one" in " ".join(child.cmdline()):
                found.append(child)
    return found


def table(path):
    return pq.read_table(path).drop_columns(["written"])


@pytest.mark.integration
@pytest.mark.timeout(300)
def test_killed_interrupted_and_resumed_a_sweep_ends_with_the_same_weights_and_rows(tmp_path, capsys):
    path = tmp_path / "small.toml"
    path.write_text(TEXT)
    every = plan.members(file.read(path), path)
    for member in every:  # without interruption, in this process
        one.do(Work(member, tmp_path / "whole", "all"))
    whole = state.read(every[0].place(tmp_path / "whole"))
    assert [member.name for member in every] == ["override/icaa/0", "override/exact/0"]

    out = tmp_path / "out"
    folder, command = every[0].place(out), ["sweep", str(path), "--out", str(out), "--jobs", "1", "--json"]
    begun = lambda: any(segment.stat().st_size for segment in folder.glob("dataset/segment-*"))  # noqa: E731
    killer = when(begun, lambda: [child.send_signal(signal.SIGKILL) for child in children()])
    assert main.main(command) == 1
    killer.join()
    printed = capsys.readouterr()
    summary = json.loads(printed.out.splitlines()[-1])
    assert summary["failed"] == [
        {"run": "override/icaa/0", "cause": "its process was ended by SIGKILL", "log": str(folder.with_name("0.log"))}
    ]
    assert summary["done"] == 1 and "failed: override/icaa/0: its process was ended by SIGKILL" in printed.err
    assert not state.load(folder).training and state.load(every[1].place(out)).collected == ["online", "attack", "offline"]

    stopper = when(lambda: bool(children()), lambda: os.kill(os.getpid(), signal.SIGTERM))
    assert main.main(command) == 130
    stopper.join()
    assert not children() and f"continues the runs in {out}" in capsys.readouterr().err

    assert main.main(command) == 0
    found = json.loads((out / "runs.json").read_text())
    by_name = {one["run"]: one for one in found}
    assert by_name["override/icaa/0"]["weights_digest"] == whole.training["weights_digest"]
    assert by_name["override/icaa/0"]["dataset_digest"] == whole.training["dataset_digest"]
    assert set(by_name["override/icaa/0"]["cpu_seconds"]) == {"collect", "fit", "evaluate"}
    for member in every:
        assert table(rows.file_of(out, member)) == table(rows.file_of(tmp_path / "whole", member)), member.name
    assert not (folder / "dataset").exists() and (folder / "checkpoints" / "version-0002.npz").is_file()

    # The rows of all runs: models without reference agents, reference agents alone, and what the training rated.
    frame = table(out / "rows.parquet").to_pandas()
    assert set(frame["setting"]) == {"override"} and set(frame["run"]) == {"override/icaa/0", "override/exact/0"}
    models, exact = frame[frame["variant"] == "icaa"], frame[frame["variant"] == "exact"]
    assert set(models["agent"]) == {"t0", "t1", "t2", "minimax"} and set(models["evaluation"]) == {
        "training",
        "online",
        "attack",
        "offline",
    }
    assert {"oracle", "random"} <= set(exact["agent"]) and set(exact["method"]) == {"exact"}
    assert set(exact["evaluation"]) == {"online", "attack", "offline"}
    online = models[models["evaluation"] == "online"]
    assert set(online["policy_version"]) == {0, 1, 2} and not online.duplicated(["agent", "p", "task_index", "episode"]).any()

    # Done again, nothing happens.
    before = (out / "rows.parquet").read_bytes()
    assert main.main(command) == 0 and not children()
    assert (out / "rows.parquet").read_bytes() == before

    # A new evaluation needs no training, and other settings of the run are refused.
    path.write_text(TEXT + "[evaluations.more]\nepisodes = 1\nseeds = 2\n")
    assert main.main([*command, "--only", "icaa", "--keep", "rows"]) == 0
    assert not folder.exists() and set(table(rows.file_of(out, every[0])).column("evaluation").to_pylist()) >= {
        "more",
        "online",
    }
    path.write_text(TEXT.replace('method = "icaa"', 'method = "icaa"\npretrain.steps = 61'))
    capsys.readouterr()
    assert main.main(command) == 2
    assert "pretrain.steps = 60 there and 61 here" in capsys.readouterr().err
