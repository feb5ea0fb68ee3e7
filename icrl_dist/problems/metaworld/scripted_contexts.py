"""Contexts of Meta-World's scripted policy: told the right goal and wrong ones by turns, with noise.

ML1 hides the goal, so a context is worth something only if its rewards betray it: an object that is carried
to the goal, or to another place, where the shaped reward says how far off that is.  A short SAC training
never lifts it.  No episode here knows more of the goal than its rewards do, apart from those that were told
it; labels are the scripted policy's at the true state, whoever led.
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
"""Largest standard deviation of what is added to an episode's actions, which lie in [-1, 1]."""
LAPSES = 0.03
"""Largest chance a step that a lapse begins: the same random action for up to ``LAPSE`` steps."""
LAPSE = 20


def scripted_context(job: Job, problem: Problem, worker: str, progress: Progress = no_progress) -> Iterator[Trajectory]:
    """Episodes D^{i,k} that the scripted policy leads in each variation, query states and labels.

    Of its trials every other one is told the true goal; the rest are told places in the box that goals
    lie in, a new one at some step.  Settings: ``queries`` a trajectory; ``windows``, ``window`` and
    ``decoy_fraction`` as for ``train_expert``.  Raises RuntimeError for a variation whose simulation keeps breaking down.
    """
    payload = job.payload
    assert isinstance(payload, ScriptedContexts)
    env = problem.batch(job.variations)
    recorder, count = Recorder(env, job.trials, job.trials), len(job.variations)
    goals = np.array([variation.task.vector("goal") for variation in job.variations])
    for trial in range(job.trials):
        rngs = [Identity(job.stage, job.round, i, k, trial).rng(job.seed) for i, k in job.rows()]
        leads = [Lead.drawn(rng, goal, trial % 2 == 0, env.spec) for rng, goal in zip(rngs, goals, strict=True)]
        recorder.reset(rngs)
        for step in range(env.spec.horizon):
            recorder.step(_actions(problem, env.truth, leads, step))  # type: ignore[attr-defined]
        progress(f"{count * (trial + 1)} of {count * job.trials} episodes of the scripted policy")
    columns = with_labels(recorder.columns(), problem, None)
    if payload.labelling.windows:
        seeds = [expert_seed(variation, job.seed) for variation in job.variations]
        led = window_episodes(env, problem, None, seeds, range(count))
    else:
        led = {name: column[:, :0] for name, column in columns.items() if name != "adversary"}
    found = make_histories(job, job.variations, columns, led, np.zeros((count, 0), np.float32), progress)
    yield from history_trajectories(job, problem, payload.labelling, found, worker, None)


class Lead(NamedTuple):
    """What one episode's leader is told and what disturbs it, all drawn at its start."""

    goals: Float64[np.ndarray, "H 3"]
    """Told at each step, in metres."""
    noise: Float32[np.ndarray, "H A"]
    """Added to its actions."""
    lapsed: Bool[np.ndarray, " H"]
    """Where the random action below is taken instead."""
    instead: Float32[np.ndarray, "H A"]

    @classmethod
    def drawn(cls, rng: np.random.Generator, goal: Float64[np.ndarray, " 3"], right: bool, spec: Spec) -> Lead:
        """Of an episode that is told the ``right`` goal, or wrong ones."""
        steps, (low, high) = spec.horizon, np.array(pick_place.GOALS)
        told = low + (high - low) * rng.random((2, 3))
        change = int(rng.integers(steps // 3, steps + 1))
        chosen = np.where(np.arange(steps)[:, None] < change, told[0], told[1])
        noise = rng.uniform(0, NOISE) * rng.standard_normal((steps, spec.actions))
        lapsed, instead = _lapses(rng, steps, spec.actions)
        return cls(np.tile(goal, (steps, 1)) if right else chosen, noise.astype(np.float32), lapsed, instead)


def _lapses(rng: np.random.Generator, steps: int, actions: int) -> tuple[Bool[np.ndarray, " H"], Float32[np.ndarray, "H A"]]:
    begins: Int[np.ndarray, " N"] = np.flatnonzero(rng.random(steps) < rng.uniform(0, LAPSES))
    lapsed, instead = np.zeros(steps, bool), np.zeros((steps, actions), np.float32)
    for begin in begins.tolist():
        end = begin + int(rng.integers(1, LAPSE + 1))
        lapsed[begin:end], instead[begin:end] = True, rng.uniform(-1, 1, actions)
    return lapsed, instead


def _actions(problem: Problem, truth: Float64[np.ndarray, "B S"], leads: list[Lead], step: int) -> Float32[np.ndarray, "B A"]:
    """What each row's leader does at this step."""
    told = np.concatenate([truth[:, :-3], np.stack([one.goals[step] for one in leads])], axis=1)
    noisy = np.clip(scripted_actions(problem, told) + np.stack([one.noise[step] for one in leads]), -1.0, 1.0)
    lapsed = np.array([one.lapsed[step] for one in leads])[:, None]
    return np.where(lapsed, np.stack([one.instead[step] for one in leads]), noisy).astype(np.float32)
