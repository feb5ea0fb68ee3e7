"""Trajectories from expert histories: episodes, query states and action windows, with labels.

Action windows (zeta of eq. 6) are cut from episodes in which an expert acts: the variation's own, or, for
decoys, the expert of another task.  Labels are those of the variation in both cases.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterator, Sequence

import numpy as np
from jaxtyping import Bool, Float32

from icrl_dist.experts.cache import History, expert_seed
from icrl_dist.experts.payloads import WINDOW_EPISODES, ExpertLabelling
from icrl_dist.experts.sac import draws
from icrl_dist.interfaces import Batch, Problem
from icrl_dist.rollout.recorder import Recorder
from icrl_dist.types import Identity, Job, Trajectory

_LABELLING = 1
"""Part of the random key of query states and windows; the trajectory's own key is the one of its episode."""

Act = Callable[[np.ndarray], np.ndarray]
"""Mean actions (N, E, A) of N experts in E states of each (N, E, S)."""


def history_trajectories(
    job: Job, problem: Problem, labelling: ExpertLabelling, histories: Sequence[History], worker: str, act: Act | None
) -> Iterator[Trajectory]:
    """``job.trials`` episodes of each variation's history, evenly spaced, with query states and labels.

    ``act``: the experts, which act in decoys and give labels; None: the problem's scripted policy does.
    """
    decoys = _decoy_episodes(job, problem, labelling, act)
    for row, history in zip(range(len(job.variations)), histories, strict=True):
        windows = _WindowEpisodes.of(history, {name: column[row] for name, column in decoys.items()})
        for identity, episode in evenly_spaced(job, row, len(history.rewards)):
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
                **_labelled_queries(labelling, history, windows, identity.rng(job.seed, _LABELLING)),
            )


def evenly_spaced(job: Job, row: int, episodes: int) -> Iterator[tuple[Identity, int]]:
    """The trajectories of one row of a job, each with the number of its episode, evenly spaced among so many."""
    task, variation = job.rows()[row]
    for trial, episode in enumerate(np.linspace(0, episodes - 1, job.trials).round().astype(int).tolist()):
        yield Identity(job.stage, job.round, task, variation, trial), episode


@dataclasses.dataclass(frozen=True, eq=False)
class _WindowEpisodes:
    """G episodes of a variation from which action windows are cut."""

    actions: Float32[np.ndarray, "G H A"]
    observations: Float32[np.ndarray, "G H+1 S"]
    rewards: Float32[np.ndarray, "G H"]
    labels: Float32[np.ndarray, "G H A"]
    decoy: Bool[np.ndarray, " G"]
    """Episodes in which another task's expert acts."""

    @classmethod
    def of(cls, history: History, decoys: dict[str, np.ndarray]) -> _WindowEpisodes:
        """The episodes of the variation's own expert, and the decoys whose simulation did not diverge."""
        own = {name: getattr(history, f"window_{name}") for name in ("actions", "observations", "rewards", "labels")}
        others = {name: decoys[name][decoys["whole"]] if decoys else column[:0] for name, column in own.items()}
        both = {name: np.concatenate([column, others[name]]) for name, column in own.items()}
        return cls(**both, decoy=np.arange(len(both["actions"])) >= len(own["actions"]))


def _labelled_queries(
    labelling: ExpertLabelling, history: History, windows: _WindowEpisodes, rng: np.random.Generator
) -> dict[str, np.ndarray]:
    """Random query states of the history, and random action windows, with labels: the last arrays of a trajectory."""
    queries, count, length = labelling.queries, labelling.windows, labelling.window
    query = np.unravel_index(rng.integers(history.rewards.size, size=queries), history.rewards.shape)
    use_decoy = rng.random(count) < labelling.decoy_fraction
    own, decoys = np.flatnonzero(~windows.decoy), np.flatnonzero(windows.decoy)
    episodes, steps = [], []
    for decoy in use_decoy.tolist():
        episodes += [int(rng.choice(decoys if decoy and len(decoys) else own))] * length
        first = int(rng.integers(windows.rewards.shape[1] - length + 1))
        steps += list(range(first, first + length))
    cut = np.array(episodes, int), np.array(steps, int)
    return {
        "queries": np.concatenate([history.observations[:, :-1][query], windows.observations[:, :-1][cut]]),
        "labels": np.concatenate([history.labels[query], windows.labels[cut]]),
        "prev_actions": windows.actions[cut],
        "prev_rewards": windows.rewards[cut],
    }


def with_labels(columns: dict[str, np.ndarray], problem: Problem, act: Act | None) -> dict[str, np.ndarray]:
    """Recorded episodes with the right action at each state (``labels``) in place of the true states (``truths``)."""
    truths = columns.pop("truths", None)
    if truths is None:
        assert act is not None, "a problem without a scripted policy needs experts"
        states = columns["observations"][:, :, :-1]
        labels = act(states.reshape(len(states), -1, states.shape[-1]))
    else:
        labels = scripted_actions(problem, truths)
    return {**columns, "labels": labels.reshape(columns["actions"].shape)}


def window_episodes(
    env: Batch, problem: Problem, act: Act | None, seeds: Sequence[int], experts: Sequence[int]
) -> dict[str, np.ndarray]:
    """``WINDOW_EPISODES`` labelled episodes in which expert ``experts[r]`` acts in row r.

    With a scripted policy, the policy acts in row r with the goal of row ``experts[r]``.
    """
    recorder, order = Recorder(env, WINDOW_EPISODES, WINDOW_EPISODES), np.array(experts)
    for episode in range(WINDOW_EPISODES):
        observation = recorder.reset([np.random.default_rng(draws.key(seed, draws.WINDOWS, episode)) for seed in seeds])
        for _ in range(env.spec.horizon):
            actions = _expert_actions(order, observation, getattr(env, "truth", None), problem, act)
            observation = recorder.step(actions).observation
    columns = with_labels(recorder.columns(), problem, act)
    del columns["adversary"]  # action windows do not contain it
    return columns


def _decoy_episodes(job: Job, problem: Problem, labelling: ExpertLabelling, act: Act | None) -> dict[str, np.ndarray]:
    """``WINDOW_EPISODES`` episodes of each variation in which the next task's expert acts; empty without decoys.

    Initial states are the same as in the episodes of the variation's own expert.
    """
    if job.tasks == 1 or not labelling.windows or not labelling.decoy_fraction:
        return {}
    seeds = [expert_seed(variation, job.seed) for variation in job.variations]
    experts = np.roll(np.arange(len(seeds)), -(len(seeds) // job.tasks))
    return window_episodes(problem.batch(job.variations), problem, act, seeds, experts.tolist())


def _expert_actions(
    experts: np.ndarray,
    observation: Float32[np.ndarray, "B S"],
    truth: np.ndarray | None,
    problem: Problem,
    act: Act | None,
) -> Float32[np.ndarray, "B A"]:
    """The action of expert ``experts[r]`` in row r."""
    if truth is not None:
        return scripted_actions(problem, np.concatenate([truth[:, :-3], truth[experts, -3:]], axis=1))
    assert act is not None, "a problem without a scripted policy needs experts"
    by_expert = np.empty_like(observation)
    by_expert[experts] = observation
    actions: Float32[np.ndarray, "B A"] = act(by_expert[:, None])[experts, 0]
    return actions


def scripted_actions(problem: Problem, truths: np.ndarray) -> Float32[np.ndarray, "N A"]:
    """Actions of the problem's scripted policy at these true states.  Raises ValueError for a problem without one."""
    if problem.scripted is None:
        raise ValueError(f"{problem.name} has no scripted policy")
    return problem.scripted(truths.reshape(-1, truths.shape[-1]).astype(np.float64))
