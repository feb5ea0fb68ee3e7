"""The benchmark of experts: the updates of both sides, and ratios and verdicts from measured rates."""

import json
import time
from typing import Any

import numpy as np
import pytest
import torch

from icrl_dist.bench import experts, experts_gpu
from icrl_dist.bench.experts import ExpertSizes
from icrl_dist.cli import main
from icrl_dist.config import run
from icrl_dist.config.sac import SACConfig
from icrl_dist.experts.sac.batched import SACBatch
from icrl_dist.experts.sac.sb3_files import blank
from icrl_dist.problems import registry
from icrl_dist.types import Spec, Step
from tests.calls import keeping, noting

TINY = ExpertSizes(2, SACConfig(hidden=(8, 8), batch=4, replay=50), 3, 2)


def test_both_sides_are_measured_and_threads_are_restored(monkeypatch):
    monkeypatch.setattr(experts, "has_bfloat16", lambda: True)
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


def test_each_side_makes_the_timed_updates_from_the_same_replay(monkeypatch):
    made = list[Any]()
    monkeypatch.setattr(experts, "SACBatch", keeping(made, SACBatch))
    monkeypatch.setattr(experts, "blank", keeping(made, blank))
    experts.lockstep(TINY, "float32")(3)
    experts.single(TINY.config)(2)
    ours, theirs = made
    assert (ours.updates, ours.experts, theirs._n_updates) == (3, 2, 2)
    rows = ours.replay.state()["rows"]
    buffer = theirs.replay_buffer
    columns = [buffer.observations[:, 0], buffer.actions[:, 0], buffer.rewards, buffer.next_observations[:, 0]]
    np.testing.assert_array_equal(rows[0], np.concatenate(columns, axis=1))
    assert not np.array_equal(rows[0], rows[1]) and buffer.size() == 50 == len(ours.replay)


def rates(fp32, bf16, small):
    """Fake measured rates: ours relative to theirs."""
    ratios = {("float32", 10): fp32, ("bfloat16", 10): bf16, ("float32", 20): small}
    return lambda sizes, matmul_dtype, turns: (ratios[matmul_dtype, sizes.experts], 1.0)


@pytest.mark.parametrize("native", [True, False])
def test_a_ratio_below_its_bound_fails_and_emulated_bfloat16_does_not_count(native, monkeypatch, capsys):
    monkeypatch.setattr(experts, "has_bfloat16", lambda: native)
    monkeypatch.setattr(experts, "compare", rates(1.36, 2.0, 4.6))
    assert main.main(["bench", "experts", "--json"]) == (1 if native else 0)
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


def test_bfloat16_instructions_are_read_from_cpuinfo(tmp_path):
    for flags, native in (("fpu avx2 fma", False), ("avx512f avx512_bf16", True), ("amx_bf16 amx_tile", True)):
        (tmp_path / "cpuinfo").write_text(f"model name\t: AMD EPYC\nflags\t\t: {flags}\n")
        assert experts.has_bfloat16(tmp_path / "cpuinfo") is native


def test_seconds_are_refused(capsys):
    assert main.main(["bench", "experts", "--seconds", "3"]) == 2
    assert "this benchmark has a fixed size" in capsys.readouterr().err


class Still:
    """Two environments that do not change."""

    spec, batch = Spec((-1.0,) * 3, (1.0,) * 3, 2, 10, discrete=False), 2

    def reset(self, rngs):
        return np.zeros((2, 3), np.float32)

    def step(self, actions):
        return Step(np.zeros((2, 3), np.float32), np.ones(2, np.float32), False, np.zeros((2, 1), np.float32))


STILL = SACConfig(hidden=(8,), batch=4, random_steps=5, warmup=20, update_every=2, steps=1000)


def test_on_a_gpu_all_kinds_and_an_expert_set_are_measured(monkeypatch):
    """Runs on the CPU: everything except the graph."""
    monkeypatch.setattr(experts_gpu, "paper_env", lambda: (Still(), STILL))
    monkeypatch.setattr(experts_gpu, "LEAST", 1e-3)
    threads = torch.get_num_threads()
    result = experts_gpu.run(True, 40, "cpu", TINY)
    assert torch.get_num_threads() == threads
    assert result["ok"] and json.loads(json.dumps(result)) == result
    for kind in ("fp32", "bf16"):
        rate, no_graph = result[f"updates_per_s_{kind}"], result[f"updates_per_s_{kind}_no_graph"]
        assert rate > 0 and no_graph > 0 and result[f"graph_gain_{kind}"] == pytest.approx(rate / no_graph, abs=0.02)
        assert result[f"gpu_ratio_{kind}"] == pytest.approx(rate / result["sb3_updates_per_s"], abs=0.1)
    paper = result["paper_set"]
    assert (paper["experts"], paper["steps"], paper["updates"]) == (2, 20 + 40 + 10, (40 - 20) // 2 + 20 // 2 + 5)
    assert paper["bound"] in paper["ms_a_step"] and result["paper_set_hours"] == paper["hours"]
    assert "1,000 steps take" in experts_gpu.describe(result)


def test_hours_use_the_rate_of_the_warm_up_and_the_rate_with_updates(monkeypatch):
    now = [0.0]

    def made(env, config, steps, seeds, progress, device):
        trained = SACBatch(seeds, env.spec, config, device)
        for trained.steps in range(10, steps + 1, 10):
            now[0] += 1.0 if trained.steps <= 20 else 9.0 if trained.steps == 30 else 5.0
            progress(trained, np.zeros(2))
        return trained

    monkeypatch.setattr(experts_gpu, "train", made)
    monkeypatch.setattr(experts_gpu, "_parts", lambda *_: {"environment": 0.3, "update": 0.2})
    monkeypatch.setattr(time, "perf_counter", lambda: now[0])
    found = experts_gpu.expert_set(Still(), STILL, 1, torch.device("cpu"))
    assert found["steps"] == 50, "at least three episodes"
    assert found["hours"] == pytest.approx((20 * 0.1 + 980 * 0.5) / 3600, abs=1e-3)
    assert (found["steps_per_s"], found["warmup_steps_per_s"], found["bound"]) == (2.0, 10.0, "environment")


def test_a_part_that_cannot_be_measured_is_reported_and_the_others_are_measured(monkeypatch):
    real = experts.lockstep

    def lockstep(sizes, matmul_dtype, device, graph):
        if graph:
            raise RuntimeError("CUDA error: operation not permitted when stream is capturing\nand more")
        return real(sizes, matmul_dtype, device, graph)

    def missing():
        raise ModuleNotFoundError("No module named 'dm_control'")

    monkeypatch.setattr(experts_gpu, "lockstep", lockstep)
    monkeypatch.setattr(experts_gpu, "paper_env", missing)
    result = experts_gpu.run(True, 40, "cpu", TINY)
    assert not result["ok"] and result["paper_set"] is None and result["paper_set_hours"] is None
    assert result["gpu_ratio_fp32"] is None and result["updates_per_s_fp32_no_graph"] > 0
    assert "fp32: RuntimeError: CUDA error: operation not permitted when stream is capturing" in result["reasons"]
    assert "no expert set: ModuleNotFoundError: No module named 'dm_control'" in result["reasons"]
    assert "No module named" in experts_gpu.describe(result)


def test_a_ratio_below_the_bound_on_a_gpu_fails(monkeypatch):
    monkeypatch.setattr(experts_gpu, "paper_env", lambda: (Still(), STILL))
    assert experts_gpu.LEAST == 300
    monkeypatch.setattr(experts_gpu, "LEAST", 1e9)
    result = experts_gpu.run(True, 40, "cpu", TINY)
    assert not result["ok"] and len(result["reasons"]) == 2
    assert result["reasons"][0] == f"gpu_ratio_fp32 is {result['gpu_ratio_fp32']}, below 1e+09"


def test_the_expert_set_is_that_of_the_paper():
    assert experts_gpu.SIZES.experts == 160 and experts_gpu.SIZES.config.hidden == (256, 256, 256)
    paper = run.load(experts_gpu.PAPER)
    assert len(registry.of(paper).split.train) * paper.adversary.variations == 160
    assert (paper.sac.steps, paper.sac.update_every, paper.sac.warmup, paper.sac.hidden) == (200_000, 3, 5_000, (256,) * 3)


def test_the_device_selects_the_benchmark(monkeypatch, capsys):
    calls = list[Any]()
    monkeypatch.setattr(experts, "compare", rates(2.0, 3.0, 5.0))
    monkeypatch.setattr(experts_gpu, "run", noting(calls, lambda *arguments: arguments, lambda *arguments: {"ok": True}))
    monkeypatch.setattr(experts_gpu, "describe", lambda result: "a table")
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    assert main.main(["bench", "experts", "--device", "auto", "--steps", "7", "--quick"]) == 0
    assert main.main(["bench", "experts", "--device", "cuda"]) == 0
    assert calls == [(True, 7), (False, None)]
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    assert main.main(["bench", "experts", "--device", "auto"]) == 0 and main.main(["bench", "experts"]) == 0
    assert len(calls) == 2
    capsys.readouterr()
    for arguments, message in (
        (["experts", "--steps", "3"], "bench experts --device cuda"),
        (["experts", "--device", "cuda", "--steps", "0"], "must be above 0"),
        (["env", "--device", "cuda"], "it belongs to `bench experts`"),
    ):
        assert main.main(["bench", *arguments]) == 2
        assert message in " ".join(capsys.readouterr().err.split())


def test_without_a_gpu_cuda_is_refused(monkeypatch, capsys):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    assert main.main(["bench", "experts", "--device", "cuda"]) == 2
    assert "torch finds no GPU here" in " ".join(capsys.readouterr().err.split())
