"""The comparison of the two decoders: what is measured, the verdict, and the table."""

from __future__ import annotations

import json
import time
from pathlib import Path
from typing import Any

import pytest

from icrl_dist.bench import incontext
from icrl_dist.bench import incontext_decoder as decoder
from icrl_dist.cli import main
from icrl_dist.models.compiled import kinds

needs_kernel = pytest.mark.skipif(not kinds(), reason="the kernel was not built here")
SMALL = (decoder.Shape(1, 3, 2), decoder.Shape(2, 130, 4))


@pytest.fixture
def seconds(monkeypatch: pytest.MonkeyPatch) -> dict[str, Any]:
    """Fake measurements, which tests change; torch's come first."""
    values: dict[str, Any] = {"decision": [[8e-5, 9e-5, 3e-4], [2e-5]], "rollout": [[4.0], [1.6]], "rounds": [[10.0], [5.0]]}

    def found(name: str) -> Any:
        return lambda *arguments: dict(zip(("torch", "kernel"), values[name], strict=True))

    for name in values:
        monkeypatch.setattr(decoder, name, found(name))
    monkeypatch.setattr(decoder, "SHAPES", SMALL)
    monkeypatch.setattr(decoder, "kinds", lambda: ("avx2",))
    return values


def test_ratios_are_of_medians_and_have_their_bounds(seconds: dict[str, Any]) -> None:
    result = decoder.run()
    assert (result["kernel"], result["kernel_over_torch"], result["kernel_over_torch_bounds"]) == ("avx2", [4.5, 4.5], [2, 4])
    assert (result["torch_us"], result["kernel_us"]) == ([90.0, 90.0], [20.0, 20.0])
    steps = decoder.EPISODES * 100
    assert result["decisions_per_s"] == {
        str(batch): {"torch": round(batch * steps / 4), "kernel": round(batch * steps / 1.6), "ratio": 2.5, "bound": 2.0}
        for batch in (20, 512)
    }
    assert result["rounds"] == {"torch_s": 10.0, "kernel_s": 5.0, "time_ratio": 0.5, "bound": 0.6}
    assert result["decoder_missed"] == [] and json.loads(json.dumps(result)) == result
    assert "a decision, 2 x 130 transitions                   20.0      90.0    4.50       4" in decoder.describe(result)[2]


def test_each_number_that_misses_its_bound_is_named(seconds: dict[str, Any], tmp_path: Path) -> None:
    seconds |= {"decision": [[6e-5], [2e-5]], "rollout": [[4.0], [2.1]], "rounds": [[10.0], [6.1]]}
    result = incontext.run(tmp_path, decisions=True)
    assert not result["ok"]
    assert result["reasons"] == [
        "a decision in 2 environments after 130 transitions: the kernel is 3.0 times as fast as torch, below 4",
        "rollouts in 20 environments: 1.9 times torch's decisions, below 2",
        "rollouts in 512 environments: 1.9 times torch's decisions, below 2",
        "rounds of ICAA take 0.61 of torch's time, above 0.6",
    ]
    assert result["reasons"] == incontext.describe(result).splitlines()[-4:]


def test_without_a_kernel_nothing_is_compared(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(decoder, "kinds", lambda: ())
    result = incontext.run(tmp_path, decisions=True)
    assert result["ok"] and result["kernel"] is None
    assert "no compiled decoder here" in incontext.describe(result)


def test_sides_alternate_and_the_first_calls_are_not_counted(monkeypatch: pytest.MonkeyPatch) -> None:
    calls: list[str] = []
    clock = [0.0]
    monkeypatch.setattr(time, "process_time", lambda: clock[0])

    def call(side: str, cost: float) -> Any:
        def work() -> None:
            calls.append(side)
            clock[0] += 10 * cost if calls.count(side) == 1 else cost

        return work

    found = decoder.alternately({"torch": call("torch", 0.01), "kernel": call("kernel", 0.005)}, 2)
    assert calls == ["torch"] * 2 + ["kernel"] * 2 + (["torch"] * 2 + ["kernel"] * 4) * 2
    assert found["torch"] == pytest.approx([0.01] * 2) and found["kernel"] == pytest.approx([0.005] * 2)


@needs_kernel
def test_both_decoders_are_measured(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(decoder, "_SECONDS", 0.0)
    monkeypatch.setattr(decoder, "EPISODES", 1)
    for found in (decoder.decision(SMALL[1], 2), decoder.rollout(2, 1)):
        assert set(found) == {"torch", "kernel"} and min(map(min, found.values())) > 0
    assert min(decoder._reading(SMALL[0], 2)) >= 0


def test_the_option_belongs_to_this_benchmark(capsys: pytest.CaptureFixture[str]) -> None:
    assert main.main(["bench", "stream", "--decisions"]) == 2
    assert "it belongs to `bench incontext`" in capsys.readouterr().err
