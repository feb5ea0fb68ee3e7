"""Fault injection: faults land, digests do not change, and a fault that does not land fails the command."""

import dataclasses
import json

import psutil
import pytest

from icrl_dist.chaos import campaign, schedule
from icrl_dist.chaos.faults import FAULTS
from icrl_dist.chaos.striking import Struck
from icrl_dist.cli import main

SMALL = ["--set", "icaa.rounds=1", "--set", "pretrain.steps=20"]


@pytest.fixture(scope="module")
def reference(tmp_path_factory):
    """The undisturbed run, in one process."""
    folder = tmp_path_factory.mktemp("chaos") / "undisturbed"
    assert main.main(["train", "smoke", *SMALL, "--evaluate.episodes", "1", "--engine", "inline", "--out", str(folder)]) == 0
    return folder


EVIDENCE = {
    "kill-worker": "worker deaths: 1",
    "torn-tail": "segment-",
    "kill-raylet": "is gone; ",
    "kill-run": "other processes ended within",
    "flip-checkpoint": "T^0 is fitted again: True",
}


def chaos(capsys, reference, out, *arguments):
    against = ["--reference", str(reference), "--out", str(out)]
    code = main.main(["chaos", "smoke", *SMALL, "--actors", "1", *against, "--json", *arguments])
    printed = capsys.readouterr()
    answer = json.loads(printed.out.splitlines()[-1])
    assert answer["ok"] is (code == 0), printed.err
    return code, answer["faults"], printed.err


def child_processes():
    return [p.pid for p in psutil.Process().children(recursive=True)]


@pytest.mark.parametrize("fault", sorted(EVIDENCE))
def test_a_fault_lands_and_changes_no_digest(capsys, reference, tmp_path, fault):
    before = child_processes()
    code, (row,), text = chaos(capsys, reference, tmp_path, "--faults", fault)
    assert code == 0 and row["landed"] and row["equal"], text
    assert EVIDENCE[fault] in row["evidence"]
    assert row["struck"] and fault in text and "all 1 faults landed" in text
    assert not list((tmp_path / "seed-0").iterdir()) and child_processes() == before


def test_a_fault_that_does_not_land_fails_the_command(capsys, reference, tmp_path, monkeypatch):
    draw = schedule.draw
    late = lambda *drawn: dataclasses.replace(draw(*drawn), phase=2, fit=True, after=10**6)  # noqa: E731
    monkeypatch.setattr(schedule, "draw", late)
    monkeypatch.setattr(campaign, "TRIES", 1)
    code, (row,), text = chaos(capsys, reference, tmp_path, "--faults", "kill-worker")
    assert code == 1 and not row["landed"] and "the run ended before" in row["evidence"]
    assert "it did not land" in text and (tmp_path / "seed-0" / "kill-worker" / "result.json").exists()


def test_an_unequal_digest_fails_the_command(capsys, reference, tmp_path, monkeypatch):
    result = json.loads((reference / "result.json").read_text())
    for name, code in (("dataset_digest", 1), ("weights_digest", 1), ("seconds", 0)):
        struck = Struck("adapt/0, 7 trajectories", True, "it died", result | {name: "0" * 64})
        monkeypatch.setitem(FAULTS, "kill-worker", lambda *_, struck=struck: struck)
        ended, (row,), text = chaos(capsys, reference, tmp_path, "--faults", "kill-worker")
        assert ended == code and row["landed"] and row["equal"] is (code == 0) and row["attempts"] == 1
        assert ("unequal digests" in text) is bool(code)


def test_invalid_arguments_are_refused(capsys, reference, tmp_path):
    def refused(*arguments):
        assert main.main(["chaos", "smoke", "--out", str(tmp_path / "out"), *arguments]) == 2
        return capsys.readouterr().err

    assert "unknown fault; choose from kill-worker" in refused("--faults", "kill-all")
    assert "run with other settings" in refused("--reference", str(reference), "--set", "seed=1")
    assert "holds no result" in refused("--reference", str(tmp_path))
    assert "at least 1" in refused("--seeds", "0")
