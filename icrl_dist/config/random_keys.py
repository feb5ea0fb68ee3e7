"""Registry of all random streams of a run that do not belong to a trajectory.

Every random draw comes from a generator with a seed and a spawn key.  The spawn key of a trajectory is its
identity, whose first number is that of its stage (``types.STAGES``: below 100).  The spawn key of any other
stream begins with one of these keys, so no two streams share a spawn key.
"""

from __future__ import annotations

import enum

import numpy as np


@enum.unique
class RandomKey(enum.IntEnum):
    """First number of a spawn key; each purpose has its own."""

    SPLIT = 101
    """The split into training and test tasks."""
    TRAINING_ADVERSARIES = 102
    """Adversaries of training tasks: (task, round)."""
    TEST_ADVERSARIES = 103
    """Adversaries of test tasks: (task), and (task, draw) for each later draw from 1 on."""
    FIT = 104
    """Training batches: (policy version, step)."""
    OOD_CALIBRATION = 105
    """Calibration episodes of the out-of-distribution score: (task, row, episode)."""
    POSTERIOR_SUITE = 106
    """Contexts and queries of the comparison with the exact posterior."""
    RESULTS = 107
    """Bootstrap of all intervals of results; its seed is 0, so equal rows give equal intervals."""
    INITIAL_WEIGHTS = 108
    """Initial weights of a fit with ``learner.reproducible = "any-machine"``; torch draws those of other fits."""
    RETURN_NETS = 130
    """ARDT's return nets: initial weights (0), and training batches (1, step)."""


def strength_key(p: float) -> int:
    """The number of a strength p in [0, 1] in the identity of an evaluation's episodes: p in units of 1e-9, 0 for p = 0.

    It depends on p alone, so an evaluation at p has the same draws whichever other strengths are evaluated.  It
    is below 2**32, one word of a spawn key, so identities with and without disturbance have equal lengths.
    """
    return round(p * 1e9)


def sequence(seed: int, key: RandomKey, *what: int) -> np.random.SeedSequence:
    """The seed sequence of one stream."""
    return np.random.SeedSequence(seed, spawn_key=(int(key), *what))


def generator(seed: int, key: RandomKey, *what: int) -> np.random.Generator:
    """The generator of one stream."""
    return np.random.default_rng(sequence(seed, key, *what))
