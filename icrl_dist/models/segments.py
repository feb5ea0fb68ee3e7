"""Inputs of decision transformers as numpy arrays: consecutive steps of episodes, with their returns-to-go."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float32, Int64


class Segments(NamedTuple):
    """L consecutive steps of each of B episodes, at the beginning of the rows; the rest of a row is padding."""

    to_go: Float32[np.ndarray, "B L"]
    """Return-to-go before each step."""
    observations: Float32[np.ndarray, "B L S"]
    actions: Int64[np.ndarray, "B L"] | Float32[np.ndarray, "B L A"]
    steps: Int64[np.ndarray, "B L"]
    """Number of the step in its episode, from 0."""
    valid: Bool[np.ndarray, "B L"]
    """False at padding, which has zeros in the other columns.  Action 0 is an action like others."""


class PromptBatch(NamedTuple):
    """B windows, each with its prompt, and the two numbers that a deployed model needs of the whole dataset."""

    prompt: Segments
    """A row without a valid step has no prompt."""
    window: Segments
    target: float
    """Return-to-go of a deployed agent's first step: the largest return-to-go of a first step in the dataset."""
    scale: float
    """Largest size of a return-to-go in the dataset."""


def returns_to_go(rewards: Float32[np.ndarray, "*B H"]) -> Float32[np.ndarray, "*B H"]:
    """The sum of the rewards from each step to the end of the episode, undiscounted; step h includes the reward of step h."""
    summed = np.flip(np.flip(np.asarray(rewards, np.float64), -1).cumsum(-1), -1)
    return summed.astype(np.float32)
