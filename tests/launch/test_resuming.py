"""One command goes on with a run: its forms, what it may change, when it begins, and when it has nothing to do."""

import dataclasses
import json
import os
import re
import shutil
import socket
import subprocess
import sys
import time
from pathlib import Path

import pytest

import icrl_dist
from icrl_dist.cli import main as cli
from icrl_dist.config.resuming import FREE
from icrl_dist.config.run import ConfigError, dumps, load, load_folder, override
from icrl_dist.launch import auto
from icrl_dist.launch import train as launch
from icrl_dist.launch.learner_process import TrainFailed
from icrl_dist.storage.checkpoint import partial_file
from icrl_dist.storage.files import StoreError
from learner import reporter
from tests.launch.test_run_folder import files
from tests.learner.test_service import no_tensorboard

pytestmark = pytest.mark.integration

__all__ = ["no_tensorboard"]


@pytest.fixture(scope="module")
def module_run(module_run, tmp_path_factory):
    """With its decoder and its way to fit named, as `train` names them."""
    return auto.without_auto(module_run, tmp_path_factory.mktemp("none"), resume=False)


@pytest.fixture(scope="module")
def finished(module_run, no_tensorboard, tmp_path_factory):
    """The folder of a finished and evaluated run that no test changes."""
    place = tmp_path_factory.mktemp("finished")
    (place / "small.toml").write_text(dumps(module_run))
    assert cli.main(["train", str(place / "small.toml"), "--engine", "inline", "--out", str(place / "runs" / "small")]) == 0
    return place / "runs" / "small"


@pytest.fixture
def here(finished, tmp_path, monkeypatch):
    """The current folder: with a run file, and the run in ``runs/small``."""
    shutil.copyfile(finished.parents[1] / "small.toml", tmp_path / "small.toml")
    shutil.copytree(finished, tmp_path / "runs" / "small")
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.fixture
def trained(monkeypatch):
    """The runs and folders that were to be trained; each training is interrupted in its fit, or ends with ``error``."""
    made = []

    def train_inline(run, folder, report):
        made.append((run, folder))
        (folder / "checkpoints").mkdir(exist_ok=True)
        partial_file(folder).touch()
        raise error[0]

    error = [launch.TrainInterrupted()]
    monkeypatch.setattr(launch, "train_inline", train_inline)
    return made, error


def train(*words):
    return cli.main(["train", *map(str, words), "--engine", "inline"])


def refused(capsys, *words, code=2):
    assert train(*words) == code
    (line,) = capsys.readouterr().err.strip().splitlines()
    return line


@pytest.mark.parametrize(
    "words",
    [
        "--resume runs/small",
        "runs/small --resume",
        "runs/small/ --resume",
        "runs/small/run.toml --resume",
        "--resume ./runs/small --out runs/../runs/small",
        "small.toml --resume",
        "small.toml --resume --out runs/small",
        "--resume-or-begin runs/small --evaluate.seeds 1",
    ],
)
def test_every_form_goes_on_with_the_run_of_the_folder(here, trained, module_run, words, capsys):
    assert train(*words.split()) == 130
    ((run, folder),) = trained[0]
    assert folder.resolve() == here / "runs" / "small"
    assert dataclasses.replace(run, evaluate=module_run.evaluate) == module_run
    last = capsys.readouterr().out.splitlines()[-1]
    assert re.fullmatch(r"interrupted; `icrl-dist train .*` continues from the (last )?checkpoint", last)
    trained[0].clear()
    command = last.split("`")[1]
    assert cli.main(command.split()[1:]) == 130 and trained[0] == [(run, folder)], "the command of the last line goes on"


def test_python_has_the_same_forms(here, trained, module_run):
    for what in ("runs/small", here / "runs" / "small", "runs/small/run.toml"):
        with pytest.raises(icrl_dist.TrainInterrupted):
            icrl_dist.train(what, engine="inline", resume=True)
    with pytest.raises(icrl_dist.TrainInterrupted):
        icrl_dist.train(module_run, "runs/small", engine="inline", resume_or_begin=True)
    assert trained[0] == [(module_run, here / "runs" / "small")] * 4


def test_a_folder_with_the_name_of_a_packaged_run_needs_a_slash(here, trained, module_run, capsys):
    shutil.copytree("runs/small", "smoke")
    assert "runs/smoke holds no run" in refused(capsys, "smoke", "--resume")
    assert train("smoke/", "--resume") == 130 and trained[0] == [(module_run, here / "smoke")]


def test_a_run_folder_without_resume_and_two_run_folders_are_refused(here, capsys):
    before = files(here)
    assert "runs/small is a run folder: `icrl-dist train --resume runs/small`" in refused(capsys, "runs/small")
    assert "RUN and --out are two run folders" in refused(capsys, "runs/small", "--resume", "--out", "runs/other")
    assert files(here) == before


def test_a_refusal_names_every_number_that_differs_with_both_values(here, capsys):
    line = refused(capsys, "small.toml", "--resume", "--seed", "7", "--pretrain.steps", "11", "--stream.job-tasks", "3")
    for text in ("seed = 0 there and 7 here", "pretrain.steps = 10 there and 11 here", "stream.job_tasks = 2 there and 3 here"):
        assert text in line
    assert "icrl-dist train --resume" in line


CHANGED = [
    *("alerts.collapse=0", "alerts.zero_episodes=0", "alerts.silent_s=0", "alerts.ingest=0", "alerts.labels=0"),
    *("evaluate.episodes=2", "evaluate.p=[0.3]", "evaluate.prior=uniform", "evaluate.seeds=1"),
    *("learner.cache_mb=0", "learner.device=cpu", "learner.prometheus=127.0.0.1:PORT", "learner.restarts=0"),
    *("sac.failed_experts=teach", "sac.least_return=1", "sac.least_return_disturbed=1"),
    *("sac.cache=elsewhere", "stream.certificates=elsewhere", "stream.connect=tls/127.0.0.1:9", "stream.credits=1"),
    *("stream.endpoint=tls/127.0.0.1:1", "stream.lease_s=9.5", "stream.max_message_bytes=99999", "stream.reply_timeout_s=3.5"),
]


def test_a_fit_that_is_resumed_with_every_free_number_changed_gives_the_same_bytes(here, module_run, monkeypatch, finished):
    assert {setting.partition("=")[0] for setting in CHANGED} == {f"{s}.{name}" for s, keys in FREE.items() for name in keys}

    def stop(event):
        if event.get("stage") == "fit" and event["step"] == 4:
            raise KeyboardInterrupt

    monkeypatch.setattr(reporter, "PERIOD_S", 0.0)
    with pytest.raises(icrl_dist.TrainInterrupted):
        icrl_dist.train(module_run, "runs/changed", engine="inline", progress=stop)
    assert partial_file(here / "runs" / "changed").exists()
    with socket.create_server(("127.0.0.1", 0)) as free:
        port = str(free.getsockname()[1])
    threads = ["learner.threads=2"] if module_run.learner.reproducible == "any-machine" else []
    run = override(module_run, [*(setting.replace("PORT", port) for setting in CHANGED), *threads], "--set")
    made = icrl_dist.train(run, "runs/changed", engine="inline", resume=True)
    reference = json.loads((finished / "result.json").read_text())
    for name in ("dataset_digest", "weights_digest", "trajectories"):
        assert made.result[name] == reference[name]
    assert load_folder(made.folder) == run, "the run file holds the numbers of the resumed run"


def test_resume_or_begin_begins_goes_on_and_ends_at_once_when_finished(here, module_run, trained, monkeypatch, capsys):
    words = ["small.toml", "--resume-or-begin", "--out", "runs/new"]
    for _ in range(2):
        assert train(*words) == 130
    assert trained[0] == [(module_run, here / "runs" / "new")] * 2
    command = "icrl-dist train small.toml --resume-or-begin --out runs/new --engine inline"
    assert f"interrupted; `{command}` continues" in capsys.readouterr().out.splitlines()[-1]
    trained[0].clear()
    before = files(here)
    assert train("small.toml", "--resume-or-begin", "--json") == 0
    printed = capsys.readouterr()
    assert json.loads(printed.out.splitlines()[-1]) == json.loads((here / "runs" / "small" / "result.json").read_text())
    assert "finished" in printed.err and trained[0] == [] and files(here) == before
    assert "seed = 0 there and 3 here" in refused(capsys, "small.toml", "--resume-or-begin", "--seed", "3")
    assert files(here) == before


@pytest.mark.parametrize("missing", ["result.json", "checkpoints/version-0002.npz"])
def test_a_run_that_lacks_a_part_is_not_finished(here, trained, missing):
    (here / "runs" / "small" / missing).unlink()
    assert train("small.toml", "--resume-or-begin") == 130 and len(trained[0]) == 1


@pytest.mark.parametrize("flags", ["--resume --overwrite", "--resume --resume-or-begin", "--resume-or-begin --overwrite"])
def test_contradictory_flags_change_nothing(here, capsys, flags):
    before = files(here)
    assert flags in refused(capsys, "small.toml", *flags.split())
    assert files(here) == before


def test_resume_or_begin_refuses_a_folder_of_other_files(here, capsys):
    (here / "mine").mkdir()
    (here / "mine" / "notes.txt").touch()
    assert "notes.txt" in refused(capsys, "small.toml", "--resume-or-begin", "--out", "mine")


def test_resume_or_begin_begins_where_a_killed_begin_left_only_parts(here, trained):
    (here / "runs" / "new").mkdir()
    (here / "runs" / "new" / ".run.toml.4711.part").touch()
    (here / "runs" / "new" / ".lock").touch()
    assert train("small.toml", "--resume-or-begin", "--out", "runs/new") == 130 and len(trained[0]) == 1


@pytest.mark.parametrize("error", [TrainFailed("worker w0 died 4 times"), StoreError("metrics.jsonl: could not be written")])
def test_the_line_of_a_failed_run_says_the_command_that_goes_on(here, trained, capsys, error):
    trained[1][0] = error
    line = refused(capsys, "small.toml", "--out", "runs/new", code=1)
    command = "icrl-dist train small.toml --resume --out runs/new --engine inline"
    assert line == f"icrl-dist: {error}; `{command}` continues the run"
    line = refused(capsys, "small.toml", "--overwrite", "--seed", "4", code=1)
    assert line == f"icrl-dist: {error}", "the run that is in the folder again is another one"


def test_a_failed_run_tells_python_how_to_go_on(here, trained, module_run):
    trained[1][0] = TrainFailed("worker w0 died 4 times")
    with pytest.raises(TrainFailed) as failed:
        icrl_dist.train(module_run, "runs/new", engine="inline")
    assert failed.value.__notes__ == [f"resume=True continues the run in {here / 'runs' / 'new'}"]


def test_load_refuses_a_run_folder_and_says_how_to_go_on(here):
    with pytest.raises(ConfigError, match="is a run folder: `icrl-dist train --resume runs/small`"):
        load("runs/small")


def test_a_run_killed_during_its_evaluation_is_not_finished_and_goes_on(here, finished):
    command = [sys.executable, "-m", "icrl_dist.cli", "train", "small.toml", "--engine", "inline", "--resume-or-begin"]
    command += ["--out", "runs/killed"]
    environment = os.environ | {"PYTHONPATH": str(Path(icrl_dist.__file__).parents[1])}
    long = [*command, "--evaluate.episodes", "100000"]
    process = subprocess.Popen(long, env=environment, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    deadline = time.monotonic() + 120
    while not (here / "runs" / "killed" / "checkpoints" / "version-0002.npz").exists():
        assert time.monotonic() < deadline and process.poll() is None
        time.sleep(0.05)
    time.sleep(0.3)
    process.kill()
    process.wait()
    assert not (here / "runs" / "killed" / "result.json").exists()
    assert cli.main(command[3:]) == 0
    results = [json.loads((folder / "result.json").read_text()) for folder in (finished, here / "runs" / "killed")]
    names = ("dataset_digest", "weights_digest", "trajectories", "evaluate", "rows")
    assert [results[0][name] for name in names] == [results[1][name] for name in names]
