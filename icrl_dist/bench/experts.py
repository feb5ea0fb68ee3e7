"""Updates of soft actor-critic per CPU-second: N experts in lockstep against one expert of stable-baselines3.

Both run on one core and alternate.  Drawing the batch from a full replay and the noise is included.
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
"""The spec of cheetah: 17 observation components, 6 action components."""
REPLAY = 10_000
"""Transitions in each replay."""
LEAST = {"fp32": 1.35, "bf16": 2.4, "small": 4.5}
"""Ratios below which the benchmark fails; ``bf16`` counts only on a processor with bfloat16 instructions."""


@dataclasses.dataclass(frozen=True)
class ExpertSizes:
    """One comparison: N experts in lockstep, and one of stable-baselines3."""

    experts: int
    config: SACConfig
    ours: int
    """Updates of every expert of ours per turn."""
    theirs: int
    """Updates of the expert of stable-baselines3 per turn."""


PAPER = ExpertSizes(10, SACConfig(replay=REPLAY), 2, 12)
SMALL = ExpertSizes(20, SACConfig(hidden=(64, 64), batch=128, replay=REPLAY), 10, 40)


def run(quick: bool = False, paper: ExpertSizes = PAPER, small: ExpertSizes = SMALL) -> dict[str, Any]:
    """Updates per CPU-second per expert, ours divided by those of stable-baselines3; ``quick`` takes fewer turns.

    ``ok`` is false if a ratio is below ``LEAST``; ``reasons`` lists these ratios.
    """
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        native, turns = has_bfloat16(), 3 if quick else 15
        # Without bfloat16 instructions an update takes seconds, so one turn is enough.
        bf16_turns = turns if native else 1
        found = {
            "fp32": compare(paper, "float32", turns),
            "bf16": compare(paper if native else dataclasses.replace(paper, ours=1), "bfloat16", bf16_turns),
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


def compare(sizes: ExpertSizes, matmul_dtype: MatmulDtype, turns: int) -> tuple[float, float]:
    """Updates per CPU-second per expert, ours and those of stable-baselines3: medians over ``turns`` after a warm-up turn."""
    ours, theirs = lockstep(sizes, matmul_dtype), single(sizes.config)
    found = []
    for _ in range(turns + 1):
        found.append((sizes.experts * sizes.ours / _seconds(ours, sizes.ours), sizes.theirs / _seconds(theirs, sizes.theirs)))
    our_rate, their_rate = (statistics.median(rates) for rates in zip(*found[1:], strict=True))
    return our_rate, their_rate


def _seconds(update: Callable[[int], None], count: int) -> float:
    began = time.process_time()
    update(count)
    return time.process_time() - began


def lockstep(sizes: ExpertSizes, matmul_dtype: MatmulDtype, device: str = "cpu", graph: bool = True) -> Callable[[int], None]:
    """A function that makes ``count`` updates of our experts."""
    config = sizes.config
    experts = SACBatch(range(sizes.experts), SPEC, config, device, matmul_dtype, None, graph)
    replays = [_transitions(np.random.default_rng((0, index)), config.replay) for index in range(sizes.experts)]
    rows = np.stack([np.concatenate(columns, axis=1) for columns in replays])
    experts.replay.load({"rows": rows, "added": np.array(config.replay)})
    episodes, shape = itertools.count(), (config.batch, SPEC.actions)

    def update(count: int) -> None:
        for picks, noise in update_draws(range(sizes.experts), next(episodes), shape, count, experts.device):
            experts.update_from_replay(picks, noise)

    return update


def single(config: SACConfig) -> Callable[[int], None]:
    """A function that makes ``count`` updates of an expert of stable-baselines3, in one call of its ``train``."""
    model = blank(SPEC, config)
    model.set_logger(configure(None, []))
    buffer = ReplayBuffer(config.replay, model.observation_space, model.action_space, "cpu")
    observations, actions, rewards, next_observations = _transitions(np.random.default_rng((0, 0)), config.replay)
    buffer.observations[:, 0], buffer.actions[:, 0] = observations, actions
    buffer.rewards[:], buffer.next_observations[:, 0] = rewards, next_observations
    buffer.full = True
    model.replay_buffer = buffer
    return lambda count: model.train(count, config.batch)


def _transitions(rng: np.random.Generator, count: int) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Random observations, actions, rewards and next observations, each ``(count, components)``."""
    observations, next_observations = rng.standard_normal((2, count, SPEC.observation), dtype=np.float32)
    actions = rng.uniform(-1, 1, (count, SPEC.actions)).astype(np.float32)
    return observations, actions, rng.random((count, 1), dtype=np.float32), next_observations


def has_bfloat16(cpuinfo: Path = Path("/proc/cpuinfo")) -> bool:
    """Whether the processor has bfloat16 instructions (AVX512_BF16 or AMX)."""
    words = set(cpuinfo.read_text().split())
    return bool(words & {"avx512_bf16", "amx_bf16"})


def describe(result: dict[str, Any]) -> str:
    """The result as a small table."""
    named = {
        "fp32": "10 experts of 3x256, batch 256, float32",
        "bf16": "the same, bfloat16 products",
        "small": "20 experts of 2x64, batch 128, float32",
    }
    rows = [f"{'updates per CPU-second per expert, one core':<46}{'ours':>10}{'SB3':>10}{'ratio':>8}"]
    for name, what in named.items():
        ours, theirs, ratio = (result[f"{kind}_{name}"] for kind in ("updates_per_s", "sb3_updates_per_s", "ratio"))
        rows.append(f"{what:<46}{ours:>10.2f}{theirs:>10.2f}{ratio:>8.2f}")
    if not result["bf16_native"]:
        rows.append("no AVX512_BF16 and no AMX on this processor: torch emulates bfloat16, so its ratio does not count")
    return "\n".join([*rows, *result["reasons"]])
