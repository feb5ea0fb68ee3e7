"""Contexts collected by Meta-World's scripted policy, with noise and with right and wrong goals in turn.

Observations do not contain the goal, so a context is informative only if its rewards reveal it.  They do
if the object is carried to the goal or to another position, because the shaped reward depends on its
distance to the goal; SAC does not learn to lift the object in a short training.  Labels are the
scripted policy's actions at the true state, also in episodes with wrong goals.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float32, Float64, Int

from icrl_dist.experts.cache import expert_seed
from icrl_dist.experts.payloads import ScriptedContexts
from icrl_dist.experts.train import make_histories
from icrl_dist.experts.trajectories import history_trajectories, scripted_actions, window_episodes, with_labels
from icrl_dist.interfaces import Problem, Progress, no_progress
from icrl_dist.problems.metaworld import pick_place
from icrl_dist.rollout.recorder import Recorder
from icrl_dist.types import Identity, Job, Spec, Trajectory

NOISE = 0.6
"""Maximum standard deviation of the noise on an episode's actions, which lie in [-1, 1]."""
LAPSE_PROBABILITY = 0.03
"""Maximum probability per step that a lapse begins: one random action for 1 to ``LAPSE_STEPS`` steps."""
LAPSE_STEPS = 20


def scripted_context(job: Job, problem: Problem, worker: str, progress: Progress = no_progress) -> Iterator[Trajectory]:
    """Episodes D^{i,k} of the scripted policy in each variation, with labelled query states.

    In trials with an even number the policy is given the true goal; in the others random positions in the
    box of goals, which change at most once.  Raises RuntimeError for a variation whose simulation keeps breaking down.
    """
    payload = job.payload
    assert isinstance(payload, ScriptedContexts)
    env = problem.batch(job.variations)
    recorder, count = Recorder(env, job.trials, job.trials), len(job.variations)
    goals = np.array([variation.task.vector("goal") for variation in job.variations])
    for trial in range(job.trials):
        rngs = [Identity(job.stage, job.round, i, k, trial).rng(job.seed) for i, k in job.rows()]
        plans = [EpisodePlan.drawn(rng, goal, trial % 2 == 0, env.spec) for rng, goal in zip(rngs, goals, strict=True)]
        recorder.reset(rngs)
        for step in range(env.spec.horizon):
            recorder.step(_actions(problem, env.truth, plans, step))  # type: ignore[attr-defined]
        progress(f"{count * (trial + 1)} of {count * job.trials} episodes of the scripted policy")
    columns = with_labels(recorder.columns(), problem, None)
    if payload.labelling.windows:
        seeds = [expert_seed(variation, job.seed) for variation in job.variations]
        windows = window_episodes(env, problem, None, seeds, range(count))
    else:
        windows = {name: column[:, :0] for name, column in columns.items() if name != "adversary"}
    found = make_histories(job, job.variations, columns, windows, np.zeros((count, 0), np.float32), progress)
    yield from history_trajectories(job, problem, payload.labelling, found, worker, None)


class EpisodePlan(NamedTuple):
    """The goals and the perturbations of the scripted policy in one episode, all drawn at its start."""

    goals: Float64[np.ndarray, "H 3"]
    """Goal that the policy is given at each step, in meters."""
    noise: Float32[np.ndarray, "H A"]
    """Added to the actions."""
    lapses: Bool[np.ndarray, " H"]
    """Steps at which ``lapse_actions`` replaces the policy's action."""
    lapse_actions: Float32[np.ndarray, "H A"]

    @classmethod
    def drawn(cls, rng: np.random.Generator, goal: Float64[np.ndarray, " 3"], right: bool, spec: Spec) -> EpisodePlan:
        """Draw a plan with the true goal if ``right``, else with random positions instead of it."""
        steps, (low, high) = spec.horizon, np.array(pick_place.GOALS)
        positions = low + (high - low) * rng.random((2, 3))
        change = int(rng.integers(steps // 3, steps + 1))
        wrong = np.where(np.arange(steps)[:, None] < change, positions[0], positions[1])
        noise = rng.uniform(0, NOISE) * rng.standard_normal((steps, spec.actions))
        lapses, lapse_actions = _lapses(rng, steps, spec.actions)
        return cls(np.tile(goal, (steps, 1)) if right else wrong, noise.astype(np.float32), lapses, lapse_actions)


def _lapses(rng: np.random.Generator, steps: int, actions: int) -> tuple[Bool[np.ndarray, " H"], Float32[np.ndarray, "H A"]]:
    """See ``EpisodePlan.lapses`` and ``EpisodePlan.lapse_actions``."""
    begins: Int[np.ndarray, " N"] = np.flatnonzero(rng.random(steps) < rng.uniform(0, LAPSE_PROBABILITY))
    lapses, actions_of_lapses = np.zeros(steps, bool), np.zeros((steps, actions), np.float32)
    for begin in begins.tolist():
        end = begin + int(rng.integers(1, LAPSE_STEPS + 1))
        lapses[begin:end], actions_of_lapses[begin:end] = True, rng.uniform(-1, 1, actions)
    return lapses, actions_of_lapses


def _actions(
    problem: Problem, truth: Float64[np.ndarray, "B S"], plans: list[EpisodePlan], step: int
) -> Float32[np.ndarray, "B A"]:
    """The actions of all rows at this step."""
    given = np.concatenate([truth[:, :-3], np.stack([plan.goals[step] for plan in plans])], axis=1)
    noisy = np.clip(scripted_actions(problem, given) + np.stack([plan.noise[step] for plan in plans]), -1.0, 1.0)
    lapses = np.array([plan.lapses[step] for plan in plans])[:, None]
    return np.where(lapses, np.stack([plan.lapse_actions[step] for plan in plans]), noisy).astype(np.float32)
