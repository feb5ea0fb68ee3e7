"""``icrl_dist.evaluate``: the command's evaluation as an object, and impossible calls in one line."""

import dataclasses
import inspect
import io
import json
import os
import shutil
from pathlib import Path
from typing import Any

import pytest
import torch
from rich.console import Console

import icrl_dist
from icrl_dist.cli import main
from icrl_dist.config.run import ConfigError, parse_written
from icrl_dist.models import kernel
from icrl_dist.models.compiled import Unusable
from icrl_dist.results import suites
from icrl_dist.storage.checkpoint import load_checkpoint, version_file
from tests.results.test_evaluate import folder

__all__ = ["folder"]


@pytest.mark.integration
@pytest.mark.parametrize("suite", ["online", "offline", "posterior"])
def test_an_evaluation_from_python_is_that_of_the_command(folder, suite, monkeypatch, capsys):
    output = io.StringIO()
    random = torch.get_rng_state()
    found = icrl_dist.evaluate(folder, suite=suite, episodes=6, seeds=2, p=[0.0, 0.2])
    assert torch.equal(torch.get_rng_state(), random)
    assert capsys.readouterr().out == ""
    monkeypatch.setattr(main, "_Console", lambda *_, **__: Console(file=output, width=120, soft_wrap=True))
    words = ["evaluate", str(folder), "--suite", suite, "--episodes", "6", "--seeds", "2", "--p", "0", "0.2", "--json"]
    assert main.main(words) == 0
    assert json.loads(capsys.readouterr().out) == json.loads(json.dumps(found.summary))
    assert str(found) in output.getvalue(), "print shows the command's tables"
    frame = icrl_dist.read_results(folder)
    assert len(frame) == len(found.rows) and set(found.rows.suite) == {suite}
    assert (found.figure is None) == (suite == "offline")


@pytest.mark.integration
@pytest.mark.parametrize("suite", ["online", "offline", "posterior"])
def test_results_that_cannot_be_stored_are_shown_all_the_same(folder, suite, monkeypatch, capsys):
    settings: dict[str, Any] = {"suite": suite, "episodes": 6, "seeds": 1, "p": [0.0, 0.2]}
    stored = icrl_dist.evaluate(folder, **settings)
    for name in ("results", "report"):
        shutil.rmtree(folder / name, ignore_errors=True)
        (folder / name).write_text("")  # not even root can write into it
    found = icrl_dist.evaluate(folder, **settings)
    changed = {"evaluation", "written"}
    assert found.rows.drop(columns=[*changed]).equals(stored.rows.drop(columns=[*changed]))
    (note,) = [note for note in found.notes if note.startswith("not stored")]
    assert str(folder / "results") in note and found.figure is None
    assert {**stored.summary, "figure": None} == {"figure": None, **found.summary}
    words = ["evaluate", str(folder), "--suite", suite, "--episodes", "6", "--seeds", "1", "--p", "0", "0.2", "--json"]
    assert main.main(words) == 0
    printed = capsys.readouterr()
    assert json.loads(printed.out.splitlines()[-1]).keys() == found.summary.keys() and printed.err.count("not stored: ") == 1


@pytest.mark.integration
def test_a_folder_whose_name_is_no_utf_8_is_evaluated_and_named_with_escapes(folder, tmp_path_factory, monkeypatch):
    odd = Path(os.fsdecode(os.fsencode(tmp_path_factory.mktemp("odd")) + b"/r\xff"))
    shutil.copytree(folder, odd)
    rows = icrl_dist.evaluate(odd, episodes=1, seeds=1, p=[0.0]).rows
    assert set(rows.run) == {"r\\xff"} and set(icrl_dist.read_results(odd).run) == {"r\\xff"}
    output = io.TextIOWrapper(io.BytesIO(), encoding="ascii")
    monkeypatch.setattr("sys.stdout", output)
    assert main.main(["evaluate", str(odd), "--episodes", "1", "--seeds", "1", "--p", "0"]) == 0
    output.flush()
    assert b"figure" in output.buffer.getvalue()


def test_progress_is_shown_if_it_is_asked_for_and_a_function_gets_the_events(folder, capsys):
    events: list[dict[str, Any]] = []
    (folder / "run.toml").write_text(str(load_checkpoint(version_file(folder, 0)).manifest["run"]))
    icrl_dist.evaluate(folder, episodes=1, seeds=1, p=[0.0], progress=events.append)
    assert "this run is not finished" in events[0]["text"] and events[-1]["step"] == events[-1]["steps"]
    assert capsys.readouterr().out == ""
    icrl_dist.evaluate(folder, episodes=1, seeds=1, p=[0.0], progress=True)
    printed = capsys.readouterr().out
    assert "this run is not finished" in printed and "held-out evaluation" in printed


@pytest.mark.integration
def test_an_agent_of_the_package_is_named_and_a_path_is_a_folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    found = icrl_dist.evaluate("darkroom", suite="offline", seeds=1, p=[0.0])
    assert found.summary["what"].endswith("darkroom.npz") and list(tmp_path.glob("runs/darkroom-pretrained/results/*"))
    with pytest.raises(ConfigError, match="darkroom: no such run folder or checkpoint"):
        icrl_dist.evaluate("./darkroom")


@pytest.mark.parametrize(
    ("options", "expected"),
    [
        ({"suite": "onlin"}, "--suite onlin: choose one of online, offline, posterior"),
        ({"deploy": "comitted"}, "--deploy comitted: choose one of paper, committed, growing"),
        ({"p": [1.5]}, "evaluate.p = 1.5: a probability lies in [0, 1]"),
        ({"p": []}, "evaluate.p"),
        ({"prior": "seen"}, "--prior seen: choose one of uniform, unseen"),
        ({"seeds": 0}, "evaluate.seeds = 0: must be above 0"),
    ],
)
def test_impossible_calls_are_refused_in_one_line(folder, options, expected):
    with pytest.raises(ConfigError) as refused:
        inspect.unwrap(icrl_dist.evaluate)(folder, **options)
    assert expected in str(refused.value) and "\n" not in str(refused.value)


@pytest.mark.integration
def test_a_run_by_the_kernel_is_evaluated_by_torch_where_there_is_no_kernel(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    settings: dict[str, Any] = {"episodes": 1, "seeds": 1, "p": [0.0]}
    expected = icrl_dist.evaluate("darkroom", **settings)
    read = parse_written
    by_kernel = lambda run: dataclasses.replace(run, context=dataclasses.replace(run.context, decoder="kernel"))  # noqa: E731
    monkeypatch.setattr(suites, "parse_written", lambda *given: by_kernel(read(*given)))
    for module in (kernel, suites):
        monkeypatch.setattr(module, "library", lambda name: Unusable("not compiled", "run `make kernel`"))
    monkeypatch.setattr(kernel, "kinds", lambda: ())
    events: list[dict[str, Any]] = []
    found = icrl_dist.evaluate("darkroom", **settings, progress=events.append)
    assert found.summary == expected.summary
    notes = [event["text"] for event in events if event["event"] == "note"]
    assert [note for note in notes if "kernel" in note] == [
        "torch computes the decisions, not the compiled decoder as in the run: not compiled: run `make kernel`"
    ]
