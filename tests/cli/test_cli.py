"""Bad input: one line with the value, the place and the remedy; exit code 2; no partial output.  And the start-up time."""

import json
import os
import re
import shlex
import shutil
import signal
import socket
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

from icrl_dist.cli import main
from icrl_dist.cli.train import _resume_command
from icrl_dist.launch import train
from icrl_dist.results import heldout
from tests.optional import known


def refused(capsys, *arguments):
    """The single error line of a command that must end with exit code 2."""
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
        ("[darkroom]\nsize = 1", r"darkroom.size = 1: a room has 2 to 1000 cells"),
        ("[adversary]\np_max = 1.5", r"adversary.p_max = 1.5: a probability lies in \[0, 1\]"),
        ("[evaluate]\np = [0.0, -0.1]", r"evaluate.p = -0.1: a probability lies in \[0, 1\]"),
        ('method = "ppo"', r"method = 'ppo': choose one of ad, ardt, dpt, dr, experts, ic2rl, icaa, icag, mix_dpt, "),
        ("[icaa]\ntrials = 5\ncontext_trials = 5", r"icaa.context_trials = 5: use 0 to 4: it must be below icaa.trials"),
        ("darkroom = [", r"not valid TOML"),
    ],
)
def test_a_bad_run_file(capsys, tmp_path, text, expected):
    file = tmp_path / "bad.toml"
    file.write_text(text)
    line = refused(capsys, "train", file, "--out", tmp_path / "out")
    assert re.search(expected, line) and str(file) in line
    assert not (tmp_path / "out").exists()


def test_an_unknown_run_is_refused_with_the_nearest_name(capsys, tmp_path):
    assert "did you mean 'demo'?" in refused(capsys, "train", "dmeo", "--out", tmp_path / "out")
    assert "no such file" in refused(capsys, "train", tmp_path / "none.toml")


def test_an_override_out_of_range(capsys, tmp_path):
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


@pytest.mark.integration
def test_a_port_in_use(capsys, tmp_path):
    with socket.create_server(("127.0.0.1", 0)) as occupied:
        port = occupied.getsockname()[1]
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
        ("stream.staleness=-1", "stream.staleness = -1: must be from 0 to 2^31 - 1"),
    ],
)
def test_an_invalid_setting(capsys, tmp_path, setting, expected):
    assert expected in refused(capsys, "train", "smoke", "--set", setting, "--out", tmp_path / "out")
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("flags", "expected"),
    [
        (["--practice.rounds", "2"], "--practice.rounds: practice is now called dagger: rename it"),
        (["--model.stretch=3"], "--model.stretch: model.stretch is now called model.window: rename it"),
        (["--pretrain.behaviours", "goals"], "pretrain.behaviours is now called pretrain.behaviors: rename it"),
        (["--control.train-tasks", "4"], "section [control]: problem = 'darkroom' has no such section, it belongs to dmc-"),
        (
            ["--problem", "dmc-hopper-hop", "--darkroom.size=4"],
            "--darkroom.size: section [darkroom]: problem = 'dmc-hopper-hop' has no such section, it belongs to darkroom;",
        ),
        (["--problem", "dmc-hopper-hop", "--control.train_tasks", "5"], "control.train_tasks = 5: use 4, 16 or 36"),
        (["--problem", "dmc-hoper-hop"], "problem = 'dmc-hoper-hop'; did you mean 'dmc-hopper-hop'?"),
        (["--set", "practice.rounds=1"], "--set: practice is now called dagger: rename it"),
    ],
)
def test_a_flag_with_a_former_name_or_of_another_problem_has_the_hint_of_run_files(capsys, tmp_path, flags, expected):
    assert expected in refused(capsys, "train", "smoke", *flags, "--engine", "inline", "--out", tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_flags_of_a_run_that_is_forked_are_checked_by_its_problem(capsys, tmp_path):
    (tmp_path / "checkpoints").mkdir()
    (tmp_path / "checkpoints" / "version-0000.npz").touch()
    (tmp_path / "run.toml").write_text("[darkroom]\nsize = 4")
    words = ["--from", f"{tmp_path}@0", "--out", tmp_path / "out", "--control.horizon", "3"]
    assert "--control.horizon: section [control]: problem = 'darkroom'" in refused(capsys, "train", *words)


def test_a_former_option_is_refused_with_its_new_name(capsys):
    assert refused(capsys, "bench", "disturbance", "--bite", "0.25") == "icrl-dist: --bite is now called --drop: rename it"


def test_a_home_in_the_run_folder_is_expanded(capsys, tmp_path, monkeypatch):
    """`ray job submit` quotes every word, so no shell expands it."""
    monkeypatch.setenv("HOME", str(tmp_path))
    (tmp_path / "runs" / "mine").mkdir(parents=True)
    (tmp_path / "runs" / "mine" / "notes").touch()
    assert f"{tmp_path}/runs/mine exists" in refused(capsys, "train", "smoke", "--engine", "inline", "--out", "~/runs/mine")
    assert "--out ~nobody-here/mine" in refused(capsys, "train", "smoke", "--engine", "inline", "--out", "~nobody-here/mine")


def test_train_needs_a_run_and_from_needs_an_existing_run(capsys, tmp_path):
    assert "name a RUN" in refused(capsys, "train", "--out", tmp_path / "out")
    assert "holds no run" in refused(capsys, "train", "--from", f"{tmp_path}@0", "--out", tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_explain_without_a_run_or_with_a_bad_identity(capsys, tmp_path):
    assert "no such run folder" in refused(capsys, "explain", tmp_path)
    assert "STAGE/ROUND/TASK/VARIATION/TRIAL" in refused(capsys, "explain", tmp_path, "adapt/0")


@pytest.mark.integration
def test_evaluate_without_a_checkpoint_and_tap_without_a_run(capsys, tmp_path, monkeypatch):
    assert "no such run folder" in refused(capsys, "evaluate", tmp_path / "none")
    assert "holds no checkpoint" in refused(capsys, "evaluate", tmp_path)
    monkeypatch.chdir(tmp_path)
    assert "no run is active" in refused(capsys, "tap")
    line = refused(capsys, "tap", "--connect", "tcp/127.0.0.1:1", "--timeout", "0.5")
    assert "tcp/127.0.0.1:1" in line


def test_an_unknown_command_and_an_unknown_flag(capsys):
    assert "'trian'" in refused(capsys, "trian")
    with pytest.raises(SystemExit) as stopped:
        main.main(["train", "smoke", "--adversary.cuont", "3"])
    assert stopped.value.code == 2
    assert "cuont" in capsys.readouterr().err


@pytest.mark.parametrize("command", sorted(main.COMMANDS))
def test_help_is_the_docstring_and_runs_nothing(capsys, command):
    with pytest.raises(SystemExit) as stopped:
        main.main([command, "--help"])
    assert stopped.value.code == 0
    printed = capsys.readouterr().out
    assert f"icrl-dist {command}" in printed and (main.COMMANDS[command][0].__doc__ or "?").split()[0] in printed


def test_the_version_is_the_packages(capsys):
    assert main.main(["--version"]) == 0
    project = tomllib.loads((Path(__file__).parents[2] / "pyproject.toml").read_text())["project"]
    assert capsys.readouterr().out.strip() == project["version"]


def test_bench_env_ends_with_one_json_object(capsys):
    assert main.main(["bench", "env", "--seconds", "0.1", "--json"]) == 0
    assert json.loads(capsys.readouterr().out.splitlines()[-1])["steps_per_s"] > 0
    assert main.main(["bench", "env", "--problem", "darkrom"]) == 2


@pytest.mark.integration
def test_train_imports_no_module_of_the_evaluation_before_the_training_ends(tmp_path):
    """The learner and the workers would wait for these imports."""
    script = """
import sys
from icrl_dist.cli import main as cli
from icrl_dist.launch import train as launch

def interrupted(*_):
    print("loaded:", *(name for name in ("torch", "scipy", "matplotlib", "mujoco", "pandas", "pyarrow") if name in sys.modules))
    raise launch.TrainInterrupted

launch.train_ray = interrupted
sys.exit(cli.main(["train", "smoke", "--actors", "1", "--out", sys.argv[1]]))
"""
    ran = subprocess.run([sys.executable, "-c", script, tmp_path / "run"], capture_output=True, text=True)
    assert ran.returncode == 130 and "loaded:" in ran.stdout.splitlines(), ran.stdout + ran.stderr


@pytest.mark.integration
def test_help_imports_no_heavy_module():
    script = """
import sys
from icrl_dist.cli import main

main.main(["--help"])
print([name for name in ("torch", "scipy", "matplotlib", "mujoco", "ray", "pandas", "pyarrow") if name in sys.modules])
"""
    ran = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)
    assert ran.stdout.splitlines()[-1] == "[]"


@pytest.mark.parametrize("name", ["SIGINT", "SIGTERM"])
def test_a_stopped_evaluation_prints_the_command_that_resumes(monkeypatch, tmp_path, capsys, name):
    def stopped(*_):
        signal.raise_signal(getattr(signal, name))
        pytest.fail("the signal was ignored")

    def trained(run, folder, report):
        (folder / "checkpoints").mkdir()
        (folder / "checkpoints" / "version-0000.npz").touch()
        return {}

    monkeypatch.setattr(train, "train_inline", trained)
    monkeypatch.setattr(heldout, "save_calibrated", stopped)
    assert main.main(["train", "smoke", "--engine", "inline", "--out", str(tmp_path / "run")]) == 130
    printed = capsys.readouterr().out
    assert (
        f"interrupted; `icrl-dist train smoke --resume --engine inline --out {tmp_path}/run` continues from the last checkpoint"
        in printed
    )
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
def test_the_resume_command_is_the_given_command_with_resume(given, printed):
    assert _resume_command(shlex.split(given)) == f"icrl-dist train {printed}"


def test_a_run_stopped_before_it_started_mentions_no_checkpoint(monkeypatch, tmp_path, capsys):
    def stopped(run, folder, *_):
        shutil.rmtree(folder)
        raise train.TrainInterrupted

    monkeypatch.setattr(train, "train_ray", stopped)
    assert main.main(["train", "smoke", "--actors", "1", "--out", str(tmp_path / "run")]) == 130
    assert capsys.readouterr().out.splitlines()[-1] == "interrupted; nothing had been done yet"  # a note may come before


def test_our_packages_are_the_ones_imported():
    import actors
    import icrl_dist
    import learner

    roots = {os.path.dirname(os.path.dirname(known(package.__file__))) for package in (actors, learner, icrl_dist)}  # noqa: PTH120
    assert len(roots) == 1


@pytest.mark.integration
@pytest.mark.parametrize("words", ["train --help", "bench --help", "explain RUN", "explain RUN pretrain/0/0/0/0", "--version"])
def test_a_reader_that_closes_the_pipe_ends_a_command_without_a_message(small_run, tmp_path, words):
    train.prepare(small_run, tmp_path / "run", resume=False, overwrite=False)
    train.train_inline(small_run, tmp_path / "run", lambda event: None)
    command = f"{shlex.quote(sys.executable)} -m icrl_dist.cli {words.replace('RUN', str(tmp_path / 'run'))}"
    script = f"{command} > >(exec 0<&-); echo $?"
    done = subprocess.run(["bash", "-c", script], capture_output=True, text=True, timeout=120)
    assert (done.stdout, done.stderr) == ("141\n", "")


def test_a_current_folder_that_was_deleted_is_named(tmp_path, monkeypatch, capsys):
    gone = tmp_path / "gone"
    gone.mkdir()
    monkeypatch.chdir(gone)
    gone.rmdir()
    assert main.main(["doctor"]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert "the current folder cannot be used (No such file or directory): change to another one" in line
