"""What a history becomes on its way to the learner: episodes, query states and windows, with their labels.

Windows are cut from episodes that an expert led (zeta of eq. 6): the variation's own, or, for a guess of
the task that is wrong, another task's, while labels are the variation's own.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterator, Sequence

import numpy as np
from jaxtyping import Bool, Float32

from icrl_dist.experts.cache import LED, History, own_seed
from icrl_dist.experts.payloads import ExpertLabelling
from icrl_dist.experts.sac import draws
from icrl_dist.interfaces import Batch, Problem
from icrl_dist.rollout.recorder import Recorder
from icrl_dist.types import Identity, Job, Trajectory

_KNOWN = 1
"""Part of the key of what is drawn for query states and windows: the trajectory's own key draws its episode."""

Act = Callable[[np.ndarray], np.ndarray]
"""Mean actions (N, E, A) of N experts in E states of each (N, E, S)."""


def delivered(
    job: Job, problem: Problem, labelling: ExpertLabelling, found: Sequence[History], worker: str, act: Act | None
) -> Iterator[Trajectory]:
    """``job.trials`` episodes of each variation's history, evenly spaced, with query states and labels.

    ``act`` is what leads and labels, or None for Meta-World's scripted policy.
    """
    decoys = _decoys(job, problem, labelling, act)
    for row, (task, variation) in enumerate(job.rows()):
        history = found[row]
        led = _Led.of(history, {name: column[row] for name, column in decoys.items()})
        chosen = np.linspace(0, len(history.rewards) - 1, job.trials).round().astype(int)
        for trial, episode in enumerate(chosen.tolist()):
            identity = Identity(job.stage, job.round, task, variation, trial)
            yield Trajectory(
                identity=identity,
                variation=job.variation(identity),
                policy_version=job.policy_version,
                weights_digest="",
                worker=worker,
                observations=history.observations[episode],
                actions=history.actions[episode],
                rewards=history.rewards[episode],
                adversary=history.adversary[episode],
                origin="expert",
                **_known(labelling, history, led, identity.rng(job.seed, _KNOWN)),
            )


@dataclasses.dataclass(frozen=True, eq=False)
class _Led:
    """G episodes that experts led in a variation."""

    actions: Float32[np.ndarray, "G H A"]
    observations: Float32[np.ndarray, "G H+1 S"]
    rewards: Float32[np.ndarray, "G H"]
    labels: Float32[np.ndarray, "G H A"]
    wrong: Bool[np.ndarray, " G"]
    """Which another task's expert led."""

    @classmethod
    def of(cls, history: History, decoys: dict[str, np.ndarray]) -> _Led:
        """The variation's own, and those of ``decoy_fraction`` that did not break down."""
        own = {name: getattr(history, f"led_{name}") for name in ("actions", "observations", "rewards", "labels")}
        others = {name: decoys[name][decoys["whole"]] if decoys else column[:0] for name, column in own.items()}
        both = {name: np.concatenate([column, others[name]]) for name, column in own.items()}
        return cls(**both, wrong=np.arange(len(both["actions"])) >= len(own["actions"]))


def _known(labelling: ExpertLabelling, history: History, led: _Led, rng: np.random.Generator) -> dict[str, np.ndarray]:
    """Query states of the history and windows of what experts led, with their labels: a trajectory's last arrays."""
    queries, windows, length = labelling.queries, labelling.windows, labelling.window
    place = np.unravel_index(rng.integers(history.rewards.size, size=queries), history.rewards.shape)
    wrong = rng.random(windows) < labelling.decoy_fraction
    right_ones, wrong_ones = np.flatnonzero(~led.wrong), np.flatnonzero(led.wrong)
    episodes, at = [], []
    for decoys in wrong.tolist():
        episodes += [int(rng.choice(wrong_ones if decoys and len(wrong_ones) else right_ones))] * length
        first = int(rng.integers(led.rewards.shape[1] - length + 1))
        at += list(range(first, first + length))
    rest = np.array(episodes, int), np.array(at, int)
    return {
        "queries": np.concatenate([history.observations[:, :-1][place], led.observations[:, :-1][rest]]),
        "labels": np.concatenate([history.labels[place], led.labels[rest]]),
        "taken": led.actions[rest],
        "gained": led.rewards[rest],
    }


def labelled(columns: dict[str, np.ndarray], problem: Problem, act: Act | None) -> dict[str, np.ndarray]:
    """Episodes with the right action at each of their states in place of the true states."""
    truths = columns.pop("truths", None)
    if truths is None:
        assert act is not None, "a game without a scripted policy"
        seen = columns["observations"][:, :, :-1]
        labels = act(seen.reshape(len(seen), -1, seen.shape[-1]))
    else:
        labels = scripted(problem, truths)
    return {**columns, "labels": labels.reshape(columns["actions"].shape)}


def lead(env: Batch, problem: Problem, act: Act | None, seeds: Sequence[int], by: Sequence[int]) -> dict[str, np.ndarray]:
    """``LED`` episodes in which row r follows expert ``by[r]``; Meta-World's is the scripted policy told that row's goal."""
    recorder, order = Recorder(env, LED, LED), np.array(by)
    for episode in range(LED):
        seen = recorder.reset([np.random.default_rng(draws.key(seed, draws.LED, episode)) for seed in seeds])
        for _ in range(env.spec.horizon):
            seen = recorder.step(_led_by(order, seen, getattr(env, "truth", None), problem, act)).observation
    columns = labelled(recorder.columns(), problem, act)
    del columns["adversary"]  # zeta holds nothing of it
    return columns


def _decoys(job: Job, problem: Problem, labelling: ExpertLabelling, act: Act | None) -> dict[str, np.ndarray]:
    """``LED`` episodes of each variation that the next task's expert leads; none if nobody asks for them or there is no other.

    Begun as those of the variation's own expert are.
    """
    if job.tasks == 1 or not labelling.windows or not labelling.decoy_fraction:
        return {}
    seeds = [own_seed(variation, job.seed) for variation in job.variations]
    by = np.roll(np.arange(len(seeds)), -(len(seeds) // job.tasks))
    return lead(problem.batch(job.variations), problem, act, seeds, by.tolist())


def _led_by(
    by: np.ndarray, seen: Float32[np.ndarray, "B S"], truth: np.ndarray | None, problem: Problem, act: Act | None
) -> Float32[np.ndarray, "B A"]:
    if truth is not None:
        return scripted(problem, np.concatenate([truth[:, :-3], truth[by, -3:]], axis=1))
    assert act is not None, "a game without a scripted policy"
    asked = np.empty_like(seen)
    asked[by] = seen
    led: Float32[np.ndarray, "B A"] = act(asked[:, None])[by, 0]
    return led


def scripted(problem: Problem, truths: np.ndarray) -> Float32[np.ndarray, "N A"]:
    """The problem's scripted policy at these true states.  Raises ValueError for a problem without one."""
    if problem.scripted is None:
        raise ValueError(f"{problem.name} has no scripted policy")
    return problem.scripted(truths.reshape(-1, truths.shape[-1]).astype(np.float64))
