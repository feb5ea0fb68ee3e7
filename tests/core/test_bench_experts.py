"""The benchmark of experts: both sides really update, and what it makes of what it measured."""

import json

import numpy as np
import pytest
import torch

from icrl_dist import cli
from icrl_dist.bench import experts
from icrl_dist.bench.experts import Sizes
from icrl_dist.games import SACConfig

TINY = Sizes(2, SACConfig(hidden=(8, 8), batch=4, replay=50), 3, 2)


def test_both_sides_are_measured_and_leave_threads_as_they_were(monkeypatch):
    monkeypatch.setattr(experts, "multiplies_bfloat16", lambda: True)
    threads = torch.get_num_threads()
    result = experts.run(True, TINY, TINY)
    assert torch.get_num_threads() == threads
    for name in ("fp32", "bf16", "small"):
        assert result[f"updates_per_s_{name}"] > 0 and result[f"sb3_updates_per_s_{name}"] > 0
        assert result[f"ratio_{name}"] == pytest.approx(
            result[f"updates_per_s_{name}"] / result[f"sb3_updates_per_s_{name}"], abs=0.02
        )
    assert json.loads(json.dumps(result)) == result
    assert f"{result['ratio_small']:.2f}" in experts.describe(result)


def test_each_side_makes_the_updates_it_is_timed_for_from_the_same_memory(monkeypatch):
    made = []
    engine, model = experts.SACBatch, experts.blank
    monkeypatch.setattr(experts, "SACBatch", lambda *given: made.append(engine(*given)) or made[-1])
    monkeypatch.setattr(experts, "blank", lambda *given: made.append(model(*given)) or made[-1])
    experts.lockstep(TINY, "float32")(3)
    experts.alone(TINY.config)(2)
    ours, theirs = made
    assert (ours.updates, ours.experts, theirs._n_updates) == (3, 2, 2)
    rows = ours.replay.state()["rows"]
    memory = theirs.replay_buffer
    columns = [memory.observations[:, 0], memory.actions[:, 0], memory.rewards, memory.next_observations[:, 0]]
    np.testing.assert_array_equal(rows[0], np.concatenate(columns, axis=1))
    assert not np.array_equal(rows[0], rows[1]) and memory.size() == 50 == len(ours.replay)


def rates(fp32, bf16, small):
    """In place of what is measured: our rate over theirs, of which the first turn is left out."""
    told = {("float32", 10): fp32, ("bfloat16", 10): bf16, ("float32", 20): small}
    return lambda sizes, products, turns: (told[products, sizes.experts], 1.0)


@pytest.mark.parametrize("native", [True, False])
def test_a_ratio_below_its_least_fails_it_and_emulated_bfloat16_does_not_count(native, monkeypatch, capsys):
    monkeypatch.setattr(experts, "multiplies_bfloat16", lambda: native)
    monkeypatch.setattr(experts, "compare", rates(1.36, 2.0, 4.6))
    assert cli.main(["bench", "experts", "--json"]) == (1 if native else 0)
    result = json.loads(capsys.readouterr().out.splitlines()[-1])
    assert (result["ratio_fp32"], result["ratio_bf16"], result["ratio_small"]) == (1.36, 2.0, 4.6)
    assert result["reasons"] == (["ratio_bf16 is 2.0, below 2.4"] if native else [])
    assert ("does not count" in experts.describe(result)) is not native
    monkeypatch.setattr(experts, "compare", rates(1.34, 2.5, 4.4))
    assert experts.run()["reasons"] == ["ratio_fp32 is 1.34, below 1.35", "ratio_small is 4.4, below 4.5"]


def test_a_rate_is_the_median_of_the_turns_after_the_first(monkeypatch):
    seconds = iter([9.0, 9.0, 1.0, 4.0, 2.0, 2.0, 6.0, 1.0])
    monkeypatch.setattr(experts, "_seconds", lambda update, count: next(seconds))
    assert experts.compare(TINY, "float32", 3) == (2 * 3 / 2.0, 2 / 2.0)


def test_what_the_processor_says_of_itself_is_read(tmp_path):
    for flags, native in (("fpu avx2 fma", False), ("avx512f avx512_bf16", True), ("amx_bf16 amx_tile", True)):
        (tmp_path / "cpuinfo").write_text(f"model name\t: AMD EPYC\nflags\t\t: {flags}\n")
        assert experts.multiplies_bfloat16(tmp_path / "cpuinfo") is native


def test_it_cannot_be_given_a_time(capsys):
    assert cli.main(["bench", "experts", "--seconds", "3"]) == 2
    assert "it takes as long as it takes" in capsys.readouterr().err
