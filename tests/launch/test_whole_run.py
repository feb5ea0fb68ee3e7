"""``icrl_dist.train``: the command's results, exceptions in place of exit codes, and a process left as it was."""

import contextlib
import dataclasses
import errno
import fcntl
import inspect
import json
import os
import re
import shutil
import signal
import subprocess
import sys
import threading
from types import SimpleNamespace
from typing import Any

import matplotlib
import pytest
import torch

import icrl_dist
from actors import fleet, local
from actors.session import SessionFailed
from icrl_dist.cli import main
from icrl_dist.config.run import ConfigError, dumps
from icrl_dist.console.signals import SIGNALS, interruptible
from icrl_dist.launch import auto, learner_process, resuming, whole_run
from icrl_dist.launch import train as launch
from icrl_dist.results import heldout, reports
from icrl_dist.storage.checkpoint import partial_file
from learner import checkpoints, reporter
from tests.actors.fake_ray import FakeRay
from tests.calls import failing
from tests.learner.test_service import no_tensorboard
from tests.results.row_blocks import block, frame

__all__ = ["no_tensorboard"]

pytestmark = pytest.mark.integration


def state():
    """What a run could change in its process."""
    return {
        "signals": [signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)],
        "random": torch.get_rng_state().tolist(),
        "deterministic": torch.get_deterministic_debug_mode(),
        "threads": torch.get_num_threads(),
        "backend": matplotlib.get_backend(auto_select=False),
        "variables": dict(os.environ),
    }


@pytest.fixture(scope="module")
def made(module_run, no_tensorboard, tmp_path_factory):
    """A run from Python: its result, what it printed, and the state of the process before and after it."""
    folder = tmp_path_factory.mktemp("python") / "run"
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("MUJOCO_GL", "disabled")  # set by the first import of a continuous problem
        output, before = folder.with_name("output"), state()
        with output.open("w") as file, contextlib.redirect_stdout(file), contextlib.redirect_stderr(file):
            result = icrl_dist.train(module_run, folder, engine="inline")
        return SimpleNamespace(result=result, printed=output.read_text(), before=before, after=state())


def test_a_run_from_python_has_the_results_of_the_command(made, module_run, tmp_path):
    (tmp_path / "small.toml").write_text(dumps(module_run))
    words = ["train", str(tmp_path / "small.toml"), "--engine", "inline", "--out", str(tmp_path / "run")]
    assert main.main(words) == 0
    there = json.loads((tmp_path / "run" / "result.json").read_text())
    assert made.result.result == json.loads((made.result.folder / "result.json").read_text())
    differing = {name for name in there if there[name] != made.result.result[name]}
    assert differing == {"folder", "seconds", "figure"} and there.keys() == made.result.result.keys()
    assert {path.name for path in (tmp_path / "run").iterdir()} == {path.name for path in made.result.folder.iterdir()}
    rows = icrl_dist.read_results(made.result.folder)
    assert made.result.evaluation.rows["return"].sum() == rows[rows.suite == "online"]["return"].sum()
    assert made.result.evaluation.figure.is_file()


def test_a_run_from_python_prints_nothing_and_leaves_its_process_as_it_was(made):
    assert made.printed == ""
    assert made.after == made.before


def test_a_run_in_another_thread_and_its_events(module_run, tmp_path, no_tensorboard):
    events: list[dict[str, Any]] = []
    made: list[Any] = []
    run = dataclasses.replace(module_run, method="icag")
    thread = threading.Thread(
        target=lambda: made.append(icrl_dist.train(run, tmp_path / "run", engine="inline", progress=events.append))
    )
    thread.start()
    thread.join()
    assert made[0].result["trajectories"] > 0
    assert {"pretrain", "fit", "evaluate"} <= {event.get("phase", "") for event in events} | {
        event.get("stage", "") for event in events
    }


def test_a_handler_that_python_cannot_set_again_is_not_replaced(monkeypatch):
    """``signal.getsignal`` gives None for a handler of an extension, and ``signal.signal`` refuses None."""
    get, was = signal.getsignal, signal.getsignal(signal.SIGTERM)
    monkeypatch.setattr(signal, "getsignal", lambda number: None if number == signal.SIGTERM else get(number))
    with interruptible():
        assert get(signal.SIGTERM) is was and get(signal.SIGINT) is not signal.default_int_handler
    assert (get(signal.SIGINT), get(signal.SIGTERM)) == (signal.default_int_handler, was)


@pytest.fixture
def session(monkeypatch):
    """A Ray session of the caller; ``ended`` lists what was done to it."""
    ray = SimpleNamespace(is_initialized=lambda: True, ended=[])
    ray.shutdown = lambda: ray.ended.append("shutdown")
    ray.init = lambda **_: ray.ended.append("init")
    monkeypatch.setitem(sys.modules, "ray", ray)
    return ray


def test_a_process_that_uses_ray_keeps_its_session(session, module_run, tmp_path):
    for address in (None, "auto"):
        with pytest.raises(ConfigError, match=r"already uses Ray.*call ray\.shutdown\(\) first.*engine='inline'$"):
            icrl_dist.train(module_run, tmp_path / "run", address=address, actors=1)
        with pytest.raises(ConfigError, match="already uses Ray"):
            fleet.Fleet(1, 0, address, oversubscribe=True)
    assert session.ended == [] and not (tmp_path / "run").exists()


REAL_SESSION = """
import sys, ray
ray.init(num_cpus=1, include_dashboard=False, log_to_driver=False, object_store_memory=100 << 20)
import icrl_dist
try:
    icrl_dist.train("smoke", sys.argv[1], actors=1)
except icrl_dist.ConfigError as error:
    print("refused:", error)
print("kept:", ray.is_initialized() and ray.get(ray.remote(lambda: 7).remote()))
ray.shutdown()
"""


def test_a_real_session_of_ray_still_works_after_the_refusal(tmp_path):
    ran = subprocess.run([sys.executable, "-c", REAL_SESSION, tmp_path / "run"], capture_output=True, text=True)
    assert "refused: engine 'ray': this process already uses Ray" in ran.stdout, ran.stderr
    assert "kept: 7" in ran.stdout, ran.stderr


@pytest.mark.parametrize("start_fails", [False, True])
def test_the_environment_is_as_it_was_after_a_fleet(monkeypatch, start_fails):
    class Session:
        def __init__(self, ray, *_, **__):
            assert os.environ["RAY_worker_niceness"] == "0"  # noqa: SIM112 - Ray's name
            assert "RAY_ADDRESS" not in os.environ
            os.environ |= {"RAY_AUTH_MODE": "token", "PYTHONBREAKPOINT": "ray"}  # as Ray does
            if start_fails:
                raise SessionFailed("Ray did not start")

        def close(self):
            pass

    ray = FakeRay(1)
    monkeypatch.setitem(sys.modules, "ray", ray)
    monkeypatch.setattr(fleet, "Session", Session)
    monkeypatch.setattr(local, "protect_token", lambda: None)
    monkeypatch.setenv("RAY_worker_niceness", "5")
    monkeypatch.setenv("RAY_ADDRESS", "192.0.2.1:6379")
    for name in ("RAY_USAGE_STATS_ENABLED", "RAY_AUTH_MODE", "PYTHONBREAKPOINT"):
        monkeypatch.delenv(name, raising=False)
    before = dict(os.environ)
    with pytest.raises(fleet.FleetFailed) if start_fails else contextlib.nullcontext():
        fleet.Fleet(1, 0).close()
    assert dict(os.environ) == before


def test_the_learner_process_has_the_waiting_policy_also_without_the_command_line(monkeypatch, tmp_path):
    monkeypatch.delenv("OMP_WAIT_POLICY", raising=False)
    program = tmp_path / "program"
    program.write_text('#!/bin/sh\necho "$OMP_WAIT_POLICY" > "$4/policy"\n')
    program.chmod(0o755)
    monkeypatch.setattr(sys, "executable", str(program))
    process = learner_process.LearnerProcess(tmp_path, "tcp/127.0.0.1:0", 0)
    process._process.wait()
    process.end()
    assert (tmp_path / "policy").read_text() == "PASSIVE\n" and "OMP_WAIT_POLICY" not in os.environ


@pytest.mark.parametrize(
    ("options", "expected"),
    [
        ({}, "name a RUN, such as demo, or another run"),
        ({"run": "smoke", "engine": "rai"}, "--engine rai: choose one of ray, inline"),
        ({"run": "smok"}, "did you mean 'smoke'?"),
        ({"run": "smoke", "actors": 0}, "--actors 0: at least 1 worker is needed"),
        ({"run": icrl_dist.load_run("smoke")}, "a Run has no name; name its run folder, as in out='runs/mine'"),
        ({"run": dataclasses.replace(icrl_dist.load_run("smoke"), seed=-1), "out": "x"}, "run: seed = -1"),
        ({"source": "nowhere@0"}, "nowhere holds no run"),
    ],
)
def test_impossible_calls_are_refused_in_one_line_and_make_no_folder(options, expected, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(ConfigError) as refused:
        inspect.unwrap(icrl_dist.train)(**{"engine": "inline", **options})  # without the tests' check of types
    assert expected in str(refused.value) and "\n" not in str(refused.value)
    assert list(tmp_path.iterdir()) == []


def test_a_folder_that_exists_needs_resume_or_overwrite(made, module_run):
    with pytest.raises(ConfigError, match="use --resume to continue the run, --overwrite to replace it"):
        icrl_dist.train(module_run, made.result.folder, engine="inline")


def test_an_interrupted_run_says_what_its_folder_holds(made, module_run, tmp_path, monkeypatch):
    """ "continues from the last checkpoint" is said only where there is one; a folder that holds nothing is removed."""
    folder, segments = tmp_path / "run", sorted((made.result.folder / "dataset").iterdir())

    def interrupted(*left):
        def train_inline(run, folder, report):
            (folder / "learner.log").write_text("a line\n")
            for path in left:
                (folder / path.parent.name).mkdir(exist_ok=True)
                shutil.copy(path, folder / path.parent.name)
            raise launch.TrainInterrupted

        monkeypatch.setattr(launch, "train_inline", train_inline)
        with pytest.raises(icrl_dist.TrainInterrupted) as stopped:
            icrl_dist.train(module_run, folder, engine="inline", overwrite=folder.exists())
        return stopped.value

    error = interrupted()
    assert not error.resumable and str(error) == "nothing had been done yet" and not folder.exists()
    error = interrupted(segments[0])
    assert error.resumable and re.fullmatch(r"the \d+ stored trajectories", error.kept) and error.kept in str(error)
    shutil.rmtree(folder)
    error = interrupted(made.result.folder / "checkpoints" / "version-0000.npz")
    assert error.resumable and error.kept == "the last checkpoint" and "resume=True" in str(error)
    error = interrupted()
    assert not error.resumable and str(error).endswith("run is as it was before") and (folder / "run.toml").exists()


@pytest.mark.parametrize("number", SIGNALS)
@pytest.mark.parametrize("moment", ["before the folder", "at the start", "after the training", "at the last file"])
def test_a_signal_at_any_moment_ends_a_run_in_order(module_run, tmp_path, monkeypatch, moment, number):
    def signalled(*_, **__):
        signal.raise_signal(number)
        pytest.fail("the signal was ignored")

    def trained(run, folder, report):
        (folder / "checkpoints").mkdir()
        (folder / "checkpoints" / "version-0000.npz").touch()
        return {}

    monkeypatch.setattr(launch, "train_inline", trained)
    monkeypatch.setattr(whole_run, "_evaluate", lambda *_: SimpleNamespace(summary={}))
    owner, name = {
        "before the folder": (launch, "prepare"),
        "at the start": (launch, "train_inline"),
        "after the training": (whole_run, "hold"),
        "at the last file": (whole_run, "write_json"),
    }[moment]
    monkeypatch.setattr(owner, name, signalled)
    with pytest.raises(icrl_dist.TrainInterrupted) as stopped:
        icrl_dist.train(module_run, tmp_path / "run", engine="inline")
    assert stopped.value.resumable or moment in ("before the folder", "at the start")


@pytest.mark.parametrize("error", [BrokenPipeError, ZeroDivisionError])
def test_a_receiver_of_events_that_fails_ends_the_run_with_a_checkpoint_of_the_fit(module_run, tmp_path, monkeypatch, error):
    def receive(event):
        if event.get("stage") == "fit" and event["step"] == 3:
            raise error("the output is closed")

    monkeypatch.setattr(reporter, "PERIOD_S", 0.0)
    with pytest.raises(error, match="the output is closed"):
        icrl_dist.train(module_run, tmp_path / "run", engine="inline", progress=receive)
    assert checkpoints.read_manifest(partial_file(tmp_path / "run"))["step"] == 3


def test_quarantined_variations_are_in_the_result_and_give_exit_code_1(module_run, tmp_path, monkeypatch, capsys):
    left_out = [{"variation": "adapt/0/1/1", "cause": "worker w0 died"}]
    produced = {"dataset_digest": "d", "weights_digest": "w", "trajectories": 3, "quarantined": left_out}
    monkeypatch.setattr(launch, "train_inline", lambda *_: dict(produced))
    monkeypatch.setattr(heldout, "save_calibrated", lambda *_: None)
    monkeypatch.setattr(heldout, "online", lambda *_: frame(block([[[1.0, 2.0]]])))
    monkeypatch.setattr(heldout, "report_name", lambda *_: "online")
    made = icrl_dist.train(module_run, tmp_path / "run", engine="inline")
    assert made.quarantined == left_out
    assert main.main(["train", "smoke", "--engine", "inline", "--out", str(tmp_path / "other")]) == 1
    assert "quarantined: adapt/0/1/1: worker w0 died" in capsys.readouterr().out


def test_load_run_takes_names_files_and_folders(made, module_run, tmp_path):
    begun = auto.without_auto(module_run, tmp_path, resume=False)
    assert icrl_dist.load_run(made.result.folder) == icrl_dist.load_run(str(made.result.folder)) == begun
    (tmp_path / "small.toml").write_text(dumps(module_run))
    for what in (tmp_path / "small.toml", str(tmp_path / "small.toml")):
        assert icrl_dist.load_run(what, "seed=3") == dataclasses.replace(module_run, seed=3)
    changed = icrl_dist.load_run("smoke", "icaa.rounds=2", "method=icag")
    assert (changed.icaa.rounds, changed.method, changed.problem) == (2, "icag", "darkroom")
    with pytest.raises(ConfigError, match=r"smoke: unknown key icaa.round; did you mean 'rounds'\?"):
        icrl_dist.load_run("smoke", "icaa.round=2")


def test_the_default_folder_is_named_after_the_run(made):
    names = {"demo": "demo", "mine/small.toml": "small", "experts-dmc": "experts-dmc"}
    assert {name: resuming.default_folder(name).as_posix() for name in names} == {n: f"runs/{f}" for n, f in names.items()}
    assert resuming.default_folder("", f"{made.result.folder}@0").as_posix() == "runs/run-from-0"


def test_an_evaluation_is_shown_by_print_and_by_a_notebook(module_run, tmp_path):
    found = reports.online(module_run, tmp_path / "report", frame(block([[[1.0, 2.0]]])))
    for text in (str(found), found._repr_mimebundle_([], [])["text/plain"]):
        assert "Return by online episode" in text and "T^0" in text and "figure" in text
    assert repr(found) == "Evaluation()"


@pytest.mark.integration
def test_a_run_on_a_file_system_without_locks_goes_on_with_one_warning(module_run, tmp_path, monkeypatch):
    monkeypatch.setattr(fcntl, "flock", failing(OSError(errno.ENOLCK, "No locks available")))
    events = list[dict[str, object]]()
    whole_run.train(module_run, tmp_path / "run", engine="inline", progress=events.append)
    (warning,) = [str(event["text"]) for event in events if "No locks available" in str(event.get("text"))]
    assert warning.startswith(f"{tmp_path / 'run'}: its file system has no locks")
