"""The one registry of random streams that are not a trajectory's.

Every random draw comes from a generator that is keyed by a seed and a spawn key.  A trajectory's spawn
key is its identity, which begins with the number of its stage (``types.STAGES``: below 100).  All other
draws of a run begin with one of these keys, so no two streams share a key.
"""

from __future__ import annotations

import enum

import numpy as np


@enum.unique
class RandomKey(enum.IntEnum):
    """First number of a spawn key, one for each purpose."""

    SPLIT = 101
    """The split into training and test tasks."""
    TRAINING_ADVERSARIES = 102
    """Adversaries of training tasks: (task, round)."""
    TEST_ADVERSARIES = 103
    """Adversaries of test tasks: (task)."""
    FIT = 104
    """Training batches: (policy version, step)."""
    OOD_CALIBRATION = 105
    """Episodes that the out-of-distribution score is calibrated on: (task, row, episode)."""
    POSTERIOR_SUITE = 106
    """Contexts, queries and bootstrap of the comparison with the exact posterior."""


def sequence(seed: int, key: RandomKey, *what: int) -> np.random.SeedSequence:
    """The seed sequence of one stream."""
    return np.random.SeedSequence(seed, spawn_key=(int(key), *what))


def generator(seed: int, key: RandomKey, *what: int) -> np.random.Generator:
    """The generator of one stream."""
    return np.random.default_rng(sequence(seed, key, *what))
