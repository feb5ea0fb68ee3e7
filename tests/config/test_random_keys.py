"""Every random stream of a run has its own spawn key, from one place."""

from __future__ import annotations

import ast
import re
from pathlib import Path

import numpy as np

from icrl_dist.config.random_keys import RandomKey, generator, sequence
from icrl_dist.types import STAGES, Identity

ROOT = Path(__file__).parents[2]
ALLOWED = ("icrl_dist/config/random_keys.py", "icrl_dist/types.py", "icrl_dist/experts/sac/draws.py")
"""Files that make seed sequences: keys of a run's streams, of trajectories, and of the draws within a SAC training."""
NO_PART_OF_A_RUN = ("icrl_dist/bench/", "icrl_dist/chaos/")
"""Measurements and fault injection: their draws are no part of a run."""


def test_keys_are_unique_and_never_the_number_of_a_stage() -> None:
    keys = [int(key) for key in RandomKey.__members__.values()]
    assert len(keys) == len(set(keys)) == len(RandomKey) > 0
    assert min(keys) >= 100 > len(STAGES)


def test_streams_differ_by_seed_key_and_numbers() -> None:
    streams = [(seed, key, what) for seed in (0, 1) for key in RandomKey for what in ((), (0,), (1,), (0, 1))]
    draws = {generator(seed, key, *what).integers(2**63) for seed, key, what in streams}
    assert len(draws) == len(streams)
    assert generator(3, RandomKey.FIT, 2).integers(2**63) == generator(3, RandomKey.FIT, 2).integers(2**63)
    trajectories = {Identity(stage, 0, 0, 0, 0).rng(0).integers(2**63) for stage in STAGES}
    assert not draws & trajectories
    assert sequence(5, RandomKey.SPLIT, 1, 2).spawn_key == (int(RandomKey.SPLIT), 1, 2)
    assert np.random.default_rng(sequence(5, RandomKey.SPLIT)).random() == generator(5, RandomKey.SPLIT).random()


def calls_seed_sequence(path: Path) -> bool:
    """Whether a file calls ``SeedSequence``, by any path to it."""
    called = [node.func for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))) if isinstance(node, ast.Call)]
    return any("SeedSequence" in (getattr(one, "attr", ""), getattr(one, "id", "")) for one in called)


def test_no_other_file_makes_a_seed_sequence() -> None:
    files = [path for package in ("icrl_dist", "actors", "learner") for path in (ROOT / package).rglob("*.py")]
    found = {path.relative_to(ROOT).as_posix() for path in files if calls_seed_sequence(path)}
    assert set(ALLOWED) <= found, "this test does not see the files that are allowed"
    strange = {
        name
        for name in found - set(ALLOWED)
        if not name.startswith(NO_PART_OF_A_RUN) and not re.fullmatch(r"icrl_dist/problems/\w+/bench\.py", name)
    }
    assert not strange, f"{sorted(strange)} must take generators from icrl_dist.config.random_keys"
