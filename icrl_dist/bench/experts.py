"""Updates of soft actor-critic: stable-baselines3, one expert at a time, beside N experts in lockstep.

Both on one core, taking turns, batches drawn from a full replay and noise included, in CPU-seconds.
"""

from __future__ import annotations

import dataclasses
import itertools
import statistics
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.logger import configure

from icrl_dist.config.sac import SACConfig
from icrl_dist.experts.sac.batched import MatmulDtype, SACBatch
from icrl_dist.experts.sac.draws import update_draws
from icrl_dist.experts.sac.sb3_files import blank
from icrl_dist.types import Spec

SPEC = Spec((-np.inf,) * 17, (np.inf,) * 17, 6, 200, discrete=False)
"""Cheetah's: 17 observation components, 6 action components."""
REMEMBERED = 10_000
"""Transitions in each replay."""
LEAST = {"fp32": 1.35, "bf16": 2.4, "small": 4.5}
"""Ratios below which the benchmark fails; that of bfloat16 only counts where the processor multiplies it."""


@dataclasses.dataclass(frozen=True)
class Sizes:
    """One comparison: N experts in lockstep, and one by stable-baselines3."""

    experts: int
    config: SACConfig
    ours: int
    """Updates a turn, of all experts."""
    theirs: int
    """Updates a turn, of the one expert."""


PAPER = Sizes(10, SACConfig(replay=REMEMBERED), 2, 12)
SMALL = Sizes(20, SACConfig(hidden=(64, 64), batch=128, replay=REMEMBERED), 10, 40)


def run(quick: bool = False, paper: Sizes = PAPER, small: Sizes = SMALL) -> dict[str, Any]:
    """Ratios of updates per CPU-second per expert, ours over stable-baselines3's; ``quick`` takes fewer turns.

    ``ok`` is false, and ``reasons`` says why, if one is below ``LEAST``.
    """
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        native, turns = multiplies_bfloat16(), 3 if quick else 15
        # A processor that does not multiply bfloat16 takes seconds an update: one turn shows it.
        few = turns if native else 1
        found = {
            "fp32": compare(paper, "float32", turns),
            "bf16": compare(paper if native else dataclasses.replace(paper, ours=1), "bfloat16", few),
            "small": compare(small, "float32", turns),
        }
    finally:
        torch.set_num_threads(threads)
    result: dict[str, Any] = {"quick": quick, "bf16_native": native, "cpu": torch.backends.cpu.get_cpu_capability()}
    for name, (ours, theirs) in found.items():
        result |= {f"ratio_{name}": round(ours / theirs, 2), f"updates_per_s_{name}": round(ours, 2)}
        result[f"sb3_updates_per_s_{name}"] = round(theirs, 2)
    counted = [name for name in LEAST if name != "bf16" or native]
    reasons = [f"ratio_{n} is {result[f'ratio_{n}']}, below {LEAST[n]}" for n in counted if result[f"ratio_{n}"] < LEAST[n]]
    return result | {"ok": not reasons, "reasons": reasons}


def compare(sizes: Sizes, matmul_dtype: MatmulDtype, turns: int) -> tuple[float, float]:
    """Updates per CPU-second per expert, ours and stable-baselines3's: medians over ``turns``, after one more."""
    ours, theirs = lockstep(sizes, matmul_dtype), alone(sizes.config)
    found = []
    for _ in range(turns + 1):
        found.append((sizes.experts * sizes.ours / _seconds(ours, sizes.ours), sizes.theirs / _seconds(theirs, sizes.theirs)))
    mine, other = (statistics.median(rates) for rates in zip(*found[1:], strict=True))  # the first finds cold caches
    return mine, other


def _seconds(update: Callable[[int], None], count: int) -> float:
    began = time.process_time()
    update(count)
    return time.process_time() - began


def lockstep(sizes: Sizes, matmul_dtype: MatmulDtype, device: str = "cpu", graph: bool = True) -> Callable[[int], None]:
    """So many updates of our experts."""
    config = sizes.config
    experts = SACBatch(range(sizes.experts), SPEC, config, device, matmul_dtype, None, graph)
    remembered = [_remembered(np.random.default_rng((0, index)), config.replay) for index in range(sizes.experts)]
    rows = np.stack([np.concatenate(columns, axis=1) for columns in remembered])
    experts.replay.load({"rows": rows, "added": np.array(config.replay)})
    episodes, shape = itertools.count(), (config.batch, SPEC.actions)

    def update(count: int) -> None:
        for picks, noise in update_draws(range(sizes.experts), next(episodes), shape, count, experts.device):
            experts.update_from_replay(picks, noise)

    return update


def alone(config: SACConfig) -> Callable[[int], None]:
    """So many updates of an expert of stable-baselines3, in one call of its ``train``."""
    model = blank(SPEC, config)
    model.set_logger(configure(None, []))
    memory = ReplayBuffer(config.replay, model.observation_space, model.action_space, "cpu")
    observations, actions, rewards, following = _remembered(np.random.default_rng((0, 0)), config.replay)
    memory.observations[:, 0], memory.actions[:, 0] = observations, actions
    memory.rewards[:], memory.next_observations[:, 0] = rewards, following
    memory.full = True
    model.replay_buffer = memory
    return lambda count: model.train(count, config.batch)


def _remembered(rng: np.random.Generator, count: int) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Observations, actions, rewards and following observations, each (count, numbers)."""
    seen, following = rng.standard_normal((2, count, SPEC.observation), dtype=np.float32)
    acted = rng.uniform(-1, 1, (count, SPEC.actions)).astype(np.float32)
    return seen, acted, rng.random((count, 1), dtype=np.float32), following


def multiplies_bfloat16(cpuinfo: Path = Path("/proc/cpuinfo")) -> bool:
    """Whether the processor itself multiplies bfloat16 numbers (AVX512_BF16 or AMX)."""
    words = set(cpuinfo.read_text().split())
    return bool(words & {"avx512_bf16", "amx_bf16"})


def describe(result: dict[str, Any]) -> str:
    """The result as a small table."""
    named = {
        "fp32": "10 experts of 3x256, batch 256, float32",
        "bf16": "the same, products of bfloat16",
        "small": "20 experts of 2x64, batch 128, float32",
    }
    rows = [f"{'updates per CPU-second per expert, one core':<46}{'ours':>10}{'SB3':>10}{'ratio':>8}"]
    for name, what in named.items():
        ours, theirs, ratio = (result[f"{kind}_{name}"] for kind in ("updates_per_s", "sb3_updates_per_s", "ratio"))
        rows.append(f"{what:<46}{ours:>10.2f}{theirs:>10.2f}{ratio:>8.2f}")
    if not result["bf16_native"]:
        rows.append("neither AVX512_BF16 nor AMX here: torch emulates products of bfloat16, and their ratio does not count")
    return "\n".join([*rows, *result["reasons"]])
