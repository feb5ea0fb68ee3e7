"""The benchmark of the first action: its sides, its ratios with their bound, and processes that fail."""

from __future__ import annotations

import json

import pytest

from icrl_dist.bench import first_action

BUSY = "import time\nend = time.process_time() + {}\nwhile time.process_time() < end: pass"


@pytest.mark.integration
def test_it_measures_new_processes_and_holds_the_ratio_to_its_bound(monkeypatch: pytest.MonkeyPatch) -> None:
    long, short = BUSY.format(0.6), BUSY.format(0.02)
    monkeypatch.setattr(first_action, "sides", lambda: {"numpy": "pass", "kernel": short, "torch": long})
    result = first_action.run(rounds=1)
    assert json.loads(json.dumps(result)) == result
    assert 0 < result["cpu_s"]["numpy"] < result["cpu_s"]["torch"] and result["cpu_s"]["torch"] > 0.6
    assert result["wall_s"]["torch"] > 0.6 and 0 < result["cpu_ratio"] < 0.5 and result["ok"]
    assert f"{result['cpu_ratio']:.2f} of the CPU time" in first_action.describe(result)
    monkeypatch.setattr(first_action, "sides", lambda: {"numpy": "pass", "kernel": short, "torch": short})
    result = first_action.run(rounds=1)
    assert not result["ok"] and "cpu_ratio" in result["reasons"][0] and "above 0.5" in result["reasons"][0]


@pytest.mark.integration
def test_without_a_kernel_there_is_no_ratio_and_a_process_that_fails_is_an_error(
    monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(first_action, "kinds", lambda: ())
    assert list(first_action.sides()) == ["numpy", "torch"]
    monkeypatch.setattr(first_action, "sides", lambda: {"numpy": "pass", "torch": "pass"})
    result = first_action.run(rounds=1)
    assert result["cpu_ratio"] is None and result["ok"]
    assert "not built here" in first_action.describe(result)
    monkeypatch.setattr(first_action, "sides", lambda: {"torch": "raise SystemExit('no torch')"})
    with pytest.raises(RuntimeError, match="ended with exit code 1"):
        first_action.run(rounds=1)
    assert "no torch" in capfd.readouterr().err
