"""Bad input: one line that names the value, the place and the remedy; exit code 2; nothing half-written."""

import json
import os
import re
import shlex
import shutil
import signal
import socket
import subprocess
import sys
from importlib import metadata

import pytest

from icrl_dist.agent import in_context_agent
from icrl_dist.cli import main
from icrl_dist.cli.train import _resuming
from icrl_dist.launch import train
from icrl_dist.results import heldout


def refused(capsys, *arguments):
    """The one line that the command printed, which must end with exit code 2."""
    assert main.main([str(a) for a in arguments]) == 2
    printed = capsys.readouterr()
    lines = printed.err.strip().splitlines()
    assert len(lines) == 1, printed
    return lines[0]


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("[darkroom]\nsiz = 4", r"unknown key darkroom.siz; did you mean 'size'\?"),
        ("[darkrom]\nsize = 4", r"unknown key darkrom; did you mean 'darkroom'\?"),
        ('[darkroom]\nsize = "7"', r"darkroom.size = '7': expected int, got str"),
        ("[darkroom]\nsize = 1", r"darkroom.size = 1: a room has at least 2 cells"),
        ("[adversary]\np_max = 1.5", r"adversary.p_max = 1.5: a probability lies in \[0, 1\]"),
        ("[evaluate]\np = [0.0, -0.1]", r"evaluate.p = -0.1: a probability lies in \[0, 1\]"),
        ('method = "ppo"', r"method = 'ppo': choose one of 'dpt', 'icag', 'icaa'"),
        ("[icaa]\ntrials = 5\ncontext_trials = 5", r"icaa.context_trials = 5: must be below icaa.trials"),
        ("darkroom = [", r"not valid TOML"),
    ],
)
def test_a_bad_run_file(capsys, tmp_path, text, expected):
    file = tmp_path / "bad.toml"
    file.write_text(text)
    line = refused(capsys, "train", file, "--out", tmp_path / "out")
    assert re.search(expected, line) and str(file) in line
    assert not (tmp_path / "out").exists()


def test_an_unknown_run_names_the_nearest(capsys, tmp_path):
    assert "did you mean 'demo'?" in refused(capsys, "train", "dmeo", "--out", tmp_path / "out")
    assert "no such file" in refused(capsys, "train", tmp_path / "none.toml")


def test_an_impossible_override(capsys, tmp_path):
    line = refused(capsys, "train", "smoke", "--adversary.p-max", "2", "--out", tmp_path / "out")
    assert "adversary.p_max = 2" in line
    assert not (tmp_path / "out").exists()


def test_a_run_folder_that_exists(capsys, tmp_path):
    (tmp_path / "precious").write_text("x")
    line = refused(capsys, "train", "smoke", "--out", tmp_path)
    assert str(tmp_path) in line and "--resume" in line and "--overwrite" in line
    line = refused(capsys, "train", "smoke", "--out", tmp_path, "--overwrite")
    assert [f.name for f in tmp_path.iterdir()] == ["precious"], "only a run is ever overwritten"


def test_more_workers_than_cores(capsys, tmp_path):
    cores = len(os.sched_getaffinity(0))
    line = refused(capsys, "train", "smoke", "--out", tmp_path / "out", "--actors", cores + 1)
    assert f"--actors {cores + 1}" in line and f"{cores} cores" in line
    assert not (tmp_path / "out").exists()
    assert "at least 1" in refused(capsys, "train", "smoke", "--out", tmp_path / "out", "--actors", "0")


def test_a_port_in_use(capsys, tmp_path):
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        line = refused(capsys, "train", "smoke", "--out", tmp_path / "out", "--stream.endpoint", f"tcp/127.0.0.1:{port}")
    assert f"tcp/127.0.0.1:{port}" in line and "free that port" in line


@pytest.mark.parametrize(
    ("setting", "expected"),
    [
        ("adversary.cuont=3", "unknown key adversary.cuont; did you mean 'count'?"),
        ("adversary.count", "SECTION.NAME=VALUE"),
        ("a.b.c=1", "SECTION.NAME=VALUE"),
        ("seed.x=1", "seed is not a section"),
        ("adversary.count=two", "adversary.count = 'two': expected int"),
        ("stream.staleness=-1", "stream.staleness = -1: must not be negative"),
    ],
)
def test_an_impossible_setting(capsys, tmp_path, setting, expected):
    assert expected in refused(capsys, "train", "smoke", "--set", setting, "--out", tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_a_run_folder_may_be_in_a_home(capsys, tmp_path, monkeypatch):
    """`ray job submit` quotes every word, so no shell resolves it."""
    monkeypatch.setenv("HOME", str(tmp_path))
    (tmp_path / "runs" / "mine").mkdir(parents=True)
    (tmp_path / "runs" / "mine" / "notes").touch()
    assert f"{tmp_path}/runs/mine exists" in refused(capsys, "train", "smoke", "--engine", "inline", "--out", "~/runs/mine")
    assert "--out ~nobody-here/mine" in refused(capsys, "train", "smoke", "--engine", "inline", "--out", "~nobody-here/mine")


def test_what_to_train_must_be_said_and_what_to_go_on_from_must_be_there(capsys, tmp_path):
    assert "name a RUN" in refused(capsys, "train", "--out", tmp_path / "out")
    assert "holds no run" in refused(capsys, "train", "--from", f"{tmp_path}@0", "--out", tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_nothing_to_explain(capsys, tmp_path):
    assert "no such run folder" in refused(capsys, "explain", tmp_path)
    assert "STAGE/ROUND/TASK/VARIATION/TRIAL" in refused(capsys, "explain", tmp_path, "adapt/0")


def test_nothing_to_evaluate_or_to_listen_to(capsys, tmp_path, monkeypatch):
    assert "no such run folder" in refused(capsys, "evaluate", tmp_path / "none")
    assert "holds no checkpoint" in refused(capsys, "evaluate", tmp_path)
    monkeypatch.chdir(tmp_path)
    assert "no run is on" in refused(capsys, "tap")
    line = refused(capsys, "tap", "--connect", "tcp/127.0.0.1:1", "--timeout", "0.5")
    assert "tcp/127.0.0.1:1" in line


def test_an_unknown_command_and_an_unknown_flag(capsys):
    assert "'trian'" in refused(capsys, "trian")
    with pytest.raises(SystemExit) as stopped:
        main.main(["train", "smoke", "--adversary.cuont", "3"])
    assert stopped.value.code == 2
    assert "cuont" in capsys.readouterr().err


@pytest.mark.parametrize("command", sorted(main.COMMANDS))
def test_help_teaches_and_does_nothing(capsys, command):
    with pytest.raises(SystemExit) as stopped:
        main.main([command, "--help"])
    assert stopped.value.code == 0
    printed = capsys.readouterr().out
    assert f"icrl-dist {command}" in printed and (main.COMMANDS[command][0].__doc__ or "?").split()[0] in printed


def test_the_version_is_the_packages(capsys):
    assert main.main(["--version"]) == 0
    assert capsys.readouterr().out.strip() == metadata.version("icrl-dist")


def test_bench_env_ends_with_one_json_object(capsys):
    assert main.main(["bench", "env", "--seconds", "0.1", "--json"]) == 0
    assert json.loads(capsys.readouterr().out.splitlines()[-1])["steps_per_s"] > 0
    assert main.main(["bench", "env", "--problem", "darkrom"]) == 2


def test_nobody_waits_for_what_only_the_evaluation_needs(tmp_path):
    """Until both programs have ended, ``train`` has imported no torch."""
    script = """
import sys
from icrl_dist.cli import main as cli
from icrl_dist.launch import train as launch

def interrupted(*_):
    print(*(name for name in ("torch", "scipy", "matplotlib", "mujoco") if name in sys.modules))
    raise launch.TrainInterrupted

launch.train_ray = interrupted
sys.exit(cli.main(["train", "smoke", "--actors", "1", "--out", sys.argv[1]]))
"""
    ran = subprocess.run([sys.executable, "-c", script, tmp_path / "run"], capture_output=True, text=True)
    assert ran.returncode == 130 and ran.stdout.splitlines()[0] == "", ran.stdout + ran.stderr


@pytest.mark.parametrize("name", ["SIGINT", "SIGTERM"])
def test_an_evaluation_that_is_stopped_says_how_to_go_on(monkeypatch, tmp_path, capsys, name):
    def stopped(*_):
        signal.raise_signal(getattr(signal, name))
        pytest.fail("it went on")

    monkeypatch.setattr(train, "train_inline", lambda *_: {})
    monkeypatch.setattr(in_context_agent, "checkpoint_file", lambda folder: folder / "none")
    monkeypatch.setattr(heldout, "calibrate", stopped)
    assert main.main(["train", "smoke", "--engine", "inline", "--out", str(tmp_path / "run")]) == 130
    printed = capsys.readouterr().out
    assert f"interrupted; `icrl-dist train smoke --resume --engine inline --out {tmp_path}/run` goes on" in printed
    assert (tmp_path / "run" / "run.toml").exists()


@pytest.mark.parametrize(
    ("given", "printed"),
    [
        ("smoke", "smoke --resume"),
        ("smoke --overwrite", "smoke --resume"),
        ("smoke --resume --seed 3", "smoke --resume --seed 3"),
        ("--from runs/demo@0 --out '~/my runs/x'", "--from runs/demo@0 --out '~/my runs/x' --resume"),
    ],
)
def test_the_command_that_goes_on_is_the_one_that_was_given(given, printed):
    assert _resuming(shlex.split(given)) == f"icrl-dist train {printed}"


def test_a_run_stopped_before_it_began_promises_no_checkpoint(monkeypatch, tmp_path, capsys):
    def stopped(run, folder, *_):
        shutil.rmtree(folder)
        raise train.TrainInterrupted

    monkeypatch.setattr(train, "train_ray", stopped)
    assert main.main(["train", "smoke", "--actors", "1", "--out", str(tmp_path / "run")]) == 130
    assert capsys.readouterr().out == "interrupted; nothing had been done yet\n"


def test_our_packages_are_the_ones_imported():
    import actors
    import icrl_dist
    import learner

    roots = {os.path.dirname(os.path.dirname(package.__file__)) for package in (actors, learner, icrl_dist)}  # noqa: PTH120
    assert len(roots) == 1
