"""Labels that a model makes from its own trials in one variation (Algorithm 3, line 14, and two extensions of it).

Algorithm 3 takes the agent's actions as labels.  Under a disturbance that the agent cannot handle these actions are
wrong, so the model would learn its own errors.  The extensions compare actions: a label is uniform over the actions
whose estimated value in the variation is nearly the best.  They need discrete actions and states that recur.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from jaxtyping import Float, Float32, Float64, Int

from icrl_dist.types import Trajectory

Labels = tuple[Float32[np.ndarray, "Q S"], Float32[np.ndarray, "Q A"]]
"""Query states and their labels."""
_Numbered = tuple[Float32[np.ndarray, "M S"], Int[np.ndarray, "N H"], Int[np.ndarray, "N H"], Int[np.ndarray, "N H"]]


def of_actions(trials: Sequence[Trajectory]) -> Labels:
    """Every state of the trials, with the action taken there: one-hot if actions are discrete, else the vector itself."""
    actions = np.concatenate([t.actions for t in trials])
    labels = actions if actions.ndim == 2 else np.eye(trials[0].labels.shape[1], dtype=np.float32)[actions]
    return np.concatenate([t.observations[:-1] for t in trials]), labels


def of_returns(trials: Sequence[Trajectory], gamma: float, slack: float) -> Labels | None:
    """The states of the trials that led to a reward, each once; actions are compared by their mean discounted return-to-go.

    Steps less than 1 / (1 - gamma) before the end are left out, because their returns-to-go are cut off.
    For ``slack`` and the result see ``_best``.
    """
    states, number, taken, _ = _numbered(trials)
    rewards = np.stack([t.rewards for t in trials]).astype(np.float64)
    horizon = rewards.shape[1]
    value, to_go = np.zeros_like(rewards), np.zeros(len(rewards))
    for step in reversed(range(horizon)):
        to_go = rewards[:, step] + gamma * to_go
        value[:, step] = to_go
    end = max(1, horizon - math.ceil(1 / (1 - gamma) - 1e-6))
    shape = len(states), trials[0].labels.shape[1]
    pairs = number[:, :end], taken[:, :end]
    visits, total = np.zeros(shape), np.zeros(shape)
    np.add.at(visits, pairs, 1.0)
    np.add.at(total, pairs, value[:, :end])
    return _best(states, total / np.maximum(visits, 1), visits, slack)


def of_transitions(trials: Sequence[Trajectory], gamma: float, slack: float) -> Labels | None:
    """The states of the trials, each once; actions are compared by value iteration on the transitions of the trials.

    The probabilities of the next states are their shares among the transitions of a state and action; the value of an
    action that was never taken in a state is unknown, and counts as 0.  Value iteration combines transitions of
    different trials, so it can find a way that no single trial took.  For ``slack`` and the result see ``_best``.
    """
    states, number, taken, arrived = _numbered(trials)
    count, actions = len(states), trials[0].labels.shape[1]
    seen, reward = np.zeros((count, actions, count)), np.zeros((count, actions))
    np.add.at(seen, (number, taken, arrived), 1.0)
    np.add.at(reward, (number, taken), np.stack([t.rewards for t in trials]).astype(np.float64))
    visits = seen.sum(axis=2)
    probability, reward = seen / np.maximum(visits, 1)[..., None], reward / np.maximum(visits, 1)
    value = reward
    for _ in range(trials[0].rewards.shape[0]):
        value = reward + gamma * (probability @ np.where(visits > 0, value, 0).max(axis=1))
    return _best(states, value, visits, slack)


def _numbered(trials: Sequence[Trajectory]) -> _Numbered:
    """The distinct states; by trial and step the number of the state, the action, and the number of the next state."""
    observations = np.stack([t.observations for t in trials])
    states, number = np.unique(observations.reshape(-1, observations.shape[2]), axis=0, return_inverse=True)
    number = number.reshape(observations.shape[:2])
    return states, number[:, :-1], np.stack([t.actions for t in trials]).astype(np.int64), number[:, 1:]


def _best(
    states: Float32[np.ndarray, "M S"], value: Float64[np.ndarray, "M A"], visits: Float[np.ndarray, "M A"], slack: float
) -> Labels | None:
    """The states with an action of value above 0, each labelled with a uniform distribution over its nearly best actions.

    ``visits``: how often each action was taken; others are never labels.  ``slack``: actions are nearly best if they
    have at least the share 1 - slack of the best value.  None if no action has a value above 0.
    """
    value = np.where(visits > 0, value, -np.inf)
    best = value.max(axis=1, keepdims=True)
    good = value >= best * (1 - slack) - 1e-9  # equal values differ by rounding
    labelled = best[:, 0] > 1e-6
    if not labelled.any():
        return None
    labels = good[labelled] / good[labelled].sum(axis=1, keepdims=True)
    return states[labelled], labels.astype(np.float32)
