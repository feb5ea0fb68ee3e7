"""Result rows of a whole sweep for tests, with known effects and known variances, in place of trainings."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from icrl_dist.results import rows
from tests.results.row_blocks import block

LEVELS = (0.0, 0.2, 0.4, 0.6)


@dataclass(frozen=True)
class Sweep:
    """Returns are ``mean(agent, p)`` + a term of the seed, of the goal and of the episode (in common), + noise of the agent."""

    mean: Callable[[str, str, float], float]
    """From variant, agent and p to the expected return."""
    agents: Mapping[str, Sequence[str]]
    """The agents of each variant."""
    setting: str = ""
    seeds: int = 6
    goals: int = 4
    evaluations: int = 2
    episodes: int = 6
    noise: float = 0.1
    """Standard deviation of an agent's own deviation in one training."""
    levels: Sequence[float] = LEVELS
    columns: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)
    """Columns of a variant that differ from the defaults."""

    def blocks(self) -> list[dict[str, Any]]:
        """Blocks of suite ``online``: the uniform adversary at all p, unseen priors at p = 0.2."""
        places = [(p, "uniform") for p in self.levels] + [(0.2, "unseen")]
        return [self._block(v, a, s, p, prior) for v, a, s in self._trainings() for p, prior in places]

    def offline(self) -> list[dict[str, Any]]:
        """Blocks of suite ``offline`` at p = 0, given random and expert data; random data cost 10."""
        found = []
        for variant, agent, seed in self._trainings():
            for data in ("",) if agent in ("oracle", "random") else ("random", "expert"):
                less = -10.0 if data == "random" else 0.0
                found.append(self._block(variant, agent, seed, 0.0, "uniform", less, episodes=1, data=data))
        return found

    def _trainings(self) -> list[tuple[str, str, int]]:
        return [(v, agent, seed) for v, agents in self.agents.items() for agent in agents for seed in range(self.seeds)]

    def _block(
        self, variant: str, agent: str, seed: int, p: float, prior: str, less: float = 0.0, episodes: int = 0, data: str = ""
    ) -> dict[str, Any]:
        shape = (self.goals, self.evaluations, episodes or self.episodes)
        shared = np.random.default_rng([seed, round(100 * p), prior == "unseen"])
        common = 3.0 * shared.standard_normal() + 2.0 * shared.standard_normal((shape[0], 1, 1))
        own = np.random.default_rng([seed, round(100 * p), *f"{variant}/{agent}/{data}/{prior}".encode()])
        values = self.mean(variant, agent, p) + less + common + self.noise * own.standard_normal()
        values = values + np.zeros(shape) + 0.01 * own.standard_normal(shape)
        task, evaluation, _ = (index.ravel() for index in np.indices(shape))
        adversaries = [json.dumps({"draw": f"{seed}-{t}-{e}-{p}-{prior}"}) for t, e in zip(task, evaluation, strict=True)]
        return {
            **block(values, agent, p, seed, run=f"{self.setting}-{variant}-{seed}", split_seed=seed, prior=prior, data=data),
            "task": np.array([json.dumps({"goal": int(t), "split": seed}) for t in task], object),
            "adversary": np.array(adversaries, object),
            "setting": self.setting,
            "variant": variant,
            "method": variant.split("-")[0],
            "adversaries": int(variant.split("-k")[1]) if "-k" in variant else 8,
            "ceiling": agent == "oracle",
            "certified": values.ravel() - 5.0,
            "training_episodes": 100,
            "labelled_episodes": 100,
            "environment_steps": 2000,
            "optimizer_steps": 300,
            "label_source": "optimal",
            **self.columns.get(variant, {}),
        }


AGENTS = {
    "dpt": ("t0",),
    "prompt_dt": ("t0",),
    "mix_dpt": ("t0",),
    "icag": ("t0",),
    "icag-k4": ("t0",),
    "icag-k16": ("t0",),
    "icaa": ("t0", "t1", "t2"),
    "exact": ("exact:dpt", "exact:icag", "oracle", "random"),
}
"""The variants of a whole sweep."""


def plain(variant: str, agent: str, p: float) -> float:
    """Returns as the paper claims them: ICAG above ICAA above DPT, by more at larger p; all lose under disturbance."""
    better = {"dpt": 0.0, "icaa": 1.5 + 0.75 * int(agent[1:]) if agent[1:].isdigit() else 0.0, "icag": 5.0, "icag-k16": 5.0}
    gain = 10.0 if variant == "exact" else better.get(variant, 0.5)
    return 70.0 - 60.0 * p + gain * (0.3 + p)


def write(folder: Path, *sweeps: Sweep, offline: bool = True) -> Path:
    """Write the rows of sweeps as the folder of one; returns its ``rows.parquet``."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    files = [rows.append(folder / "parts", "online", {}, [block for sweep in sweeps for block in sweep.blocks()])]
    if offline:
        files.append(rows.append(folder / "parts", "offline", {}, [block for sweep in sweeps for block in sweep.offline()]))
    path = folder / "rows.parquet"
    pq.write_table(pa.concat_tables([pq.read_table(file) for file in files]), path)
    return path


def small(folder, *, seeds=6, mean=plain, agents=None, columns=None, levels=(0.0, 0.2), **others):
    """The rows of a small sweep, online only."""
    chosen = agents or {"dpt": ("t0",), "icag": ("t0",), "icaa": ("t0", "t1"), "mix_dpt": ("t0",), "prompt_dt": ("t0",)}
    options = {"goals": 2, "evaluations": 1, "episodes": 2} | others
    return Sweep(mean, chosen, "room", seeds, columns=columns or {}, levels=levels, **options)
