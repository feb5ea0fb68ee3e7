"""Trains SAC experts of continuous variations and makes the histories of their training (appendix C.3).

A history holds episodes of the training, from the first random ones to the last, with the action of the
final expert at every state as label.  Workers do not send expert networks; they keep histories and experts
in a cache on their node, so that none is trained twice.  The seed of an expert depends on its variation and
the run's seed only, so the expert is the same in every job.
"""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import hashlib
import logging
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float32

from icrl_dist.config.sac import SACConfig
from icrl_dist.experts import cache, standing
from icrl_dist.experts.cache import History, Trainer, expert_seed
from icrl_dist.experts.checkpoints import Checkpoints
from icrl_dist.experts.payloads import ExpertHistories
from icrl_dist.experts.trajectories import Act, history_trajectories, scripted_actions, window_episodes, with_labels
from icrl_dist.interfaces import Batch, Problem, Progress, no_progress
from icrl_dist.rollout.recorder import Recorder
from icrl_dist.storage.checkpoint import Checkpoint, load_checkpoint, save_checkpoint
from icrl_dist.storage.files import StoreError
from icrl_dist.types import Job, Trajectory, Variation

if TYPE_CHECKING:
    import torch

    from icrl_dist.experts.sac.batched import Backend, SACBatch
    from icrl_dist.experts.sac.stacked import Shape

_log = logging.getLogger(__name__)

CHECKPOINT_S = 60.0
"""Seconds between checkpoints of a training that is not finished; after a kill it continues from the last one."""


def train_expert(job: Job, problem: Problem, worker: str, progress: Progress = no_progress) -> Iterator[Trajectory]:
    """Histories D^{i,k} of SAC experts of each variation, with query states and labels (Algorithm 2, lines 8 to 12).

    All experts of a job train together, so the first trajectory is ready after the last training step.
    Raises RuntimeError for a variation whose simulation diverges in every episode, EndsRun for experts that return less
    than ``sac.least_return`` (docs/commands.md).
    """
    payload = job.payload
    assert isinstance(payload, ExpertHistories)
    found = histories(job, problem, payload.sac, progress)
    if standing.labels_come_from_experts(problem):
        standings = standing.of(job.rows(), job.variations, found, payload.sac)
        if payload.sac.failed_experts == "refuse":
            standing.require(standings)
        elif text := standing.listed(standings):
            progress(f"{job.label}: labels are made although {text}", note=True)
    yield from history_trajectories(job, problem, payload.labelling, found, worker, _mean_actions(found, payload.sac))


def histories(job: Job, problem: Problem, config: SACConfig, progress: Progress) -> list[History]:
    """The history of each variation of the job, from the cache; those that are missing are trained and cached."""
    backend, horizon = sac_backend(len(job.variations)), problem.spec_of(job.variations[0].task).horizon
    trainer = _trainer(backend)
    cached = {variation: cache.load(variation, horizon, config, job.seed, trainer, job.trials) for variation in job.variations}
    found = {variation: history for variation, history in cached.items() if history is not None}
    missing = [variation for variation in cached if variation not in found]
    if found:
        progress(
            f"{job.label}: {len(found)} experts from the cache, {len(found) * config.steps:,} steps of SAC saved", note=True
        )
    if missing:
        if reason := cache.unusable(config):  # found before the training, which may take hours
            config = without_cache(config, reason, progress)
        for variation, history in zip(missing, _train(job, problem, missing, backend, config, progress), strict=True):
            found[variation] = history
            try:
                cache.save(history, variation, horizon, config, job.seed, trainer, job.trials)
            except StoreError as error:
                config = without_cache(config, cache.unusable(config) or str(error), progress)
    return [found[variation] for variation in job.variations]


_reported = set[str]()
"""Caches that cannot be used and were reported by this process."""


def without_cache(config: SACConfig, reason: str, progress: Progress) -> SACConfig:
    """The section without its cache, which cannot be used; the first time, a note says so."""
    if config.cache not in _reported:
        _reported.add(config.cache)
        progress(f"experts are not stored: {reason}", note=True)
    return dataclasses.replace(config, cache="")


def sac_backend(experts: int) -> Backend:
    """The implementation that trains a job's experts: stable-baselines3 for one expert on the CPU, else lockstep."""
    from icrl_dist.experts.sac.batched import pick

    return "stable-baselines3" if experts == 1 and pick("auto").type == "cpu" else "lockstep"


def _trainer(backend: Backend) -> Trainer:
    from icrl_dist.experts.sac.batched import pick

    return "lockstep, cuda" if backend == "lockstep" and pick("auto").type == "cuda" else backend


def _train(
    job: Job, problem: Problem, variations: Sequence[Variation], backend: Backend, config: SACConfig, progress: Progress
) -> list[History]:
    from icrl_dist.experts.sac.batched import train

    horizon = problem.spec_of(variations[0].task).horizon
    keys = [cache.key(variation, horizon, config, job.seed, _trainer(backend), job.trials) for variation in variations]
    part = cache.file(config, "part-" + hashlib.sha256("".join(keys).encode()).hexdigest()) if config.cache else None
    env, seeds = problem.batch(variations), [expert_seed(variation, job.seed) for variation in variations]
    episodes = cache.training_episodes(horizon, config)
    recorder = Recorder(env, episodes, cache.recorded_episodes(horizon, config, job.trials))
    checkpoints = Checkpoints(config, episodes)
    state = _load_training(part, recorder, checkpoints) if part is not None and part.exists() else None
    saved = time.monotonic()

    def report(experts: SACBatch, returns: np.ndarray) -> None:
        nonlocal saved
        if state:
            state.clear()  # it is loaded: a second replay would stay in memory until the end
        checkpoints.keep(experts.steps // horizon, experts.arrays["actor"].cpu().numpy())
        mean = f"mean return {returns.mean():.0f}"
        progress(f"{len(keys)} experts at {experts.steps:,} of {config.steps:,} steps, {mean}", reached=experts.steps)
        if part is not None and time.monotonic() - saved >= CHECKPOINT_S:
            arrays = {f"state/{name}": value for name, value in experts.state().items()}
            arrays |= {f"episodes/{name}": value for name, value in recorder.state().items()}
            arrays |= {f"checkpoints/{name}": value for name, value in checkpoints.state().items()}
            saved = time.monotonic()
            try:
                save_checkpoint(part, Checkpoint(arrays, {}))
            except StoreError as error:
                _log.warning("no checkpoint of this training: %s", error)

    experts = train(recorder, config, recorder.episodes * recorder.spec.horizon, seeds, report, state=state, backend=backend)
    checkpoints.choose(env, seeds, experts, lambda text: progress(f"{job.label}: {text}", reached=experts.steps))
    columns = with_labels(recorder.columns(), problem, experts.act)
    windows = window_episodes(env, problem, experts.act, seeds, range(env.batch))
    made = make_histories(job, variations, columns, windows, experts.arrays["actor"].cpu().numpy(), progress)
    if part is not None:
        with contextlib.suppress(OSError):
            part.unlink()
    return made


def make_histories(
    job: Job,
    variations: Sequence[Variation],
    columns: dict[str, np.ndarray],
    windows: dict[str, np.ndarray],
    actors: np.ndarray,
    progress: Progress,
) -> list[History]:
    """The history of each of these variations of the job, without episodes whose simulation diverged.

    ``columns``: training episodes; ``windows``: episodes of ``window_episodes``; ``actors``: parameters per
    variation.  Raises RuntimeError for a variation without any other episode.
    """
    parts, made = {"": columns, "window_": windows}, []
    for row, variation in enumerate(variations):
        whole = {prefix: part["whole"][row] for prefix, part in parts.items()}
        diverged = sum(int((~one).sum()) for one in whole.values())
        if diverged:
            progress(f"{job.label}: {diverged} episodes of {variation} diverged and are left out", note=True)
        if not all(one.any() for one in whole.values() if len(one)):
            raise RuntimeError(
                f"{variation}: the simulation diverges in every episode; use a weaker adversary, or another task"
            )
        arrays = {
            prefix + name: column[row][whole[prefix]]
            for prefix, part in parts.items()
            for name, column in part.items()
            if name != "whole"
        }
        made.append(History(**arrays, actor=actors[row]))
    return made


def _load_training(part: Path, recorder: Recorder, checkpoints: Checkpoints) -> dict[str, np.ndarray] | None:
    """The checkpoint of a training that was not finished; None if it cannot be read."""
    try:
        stored = load_checkpoint(part)
        recorder.load(stored.part("episodes"))
        checkpoints.load(stored.part("checkpoints"))
        return stored.part("state")
    except (StoreError, KeyError) as error:
        _log.warning("the training starts again from step 0: %s", error)
        return None


def _mean_actions(histories: Sequence[History], config: SACConfig) -> Act:
    """The mean actions of the experts of these histories."""
    first = histories[0]
    widths = first.observations.shape[-1], first.actions.shape[-1]
    return mean_actions(np.stack([history.actor for history in histories]), widths, config)


def mean_actions(actors: Float32[np.ndarray, "N P"], widths: tuple[int, int], config: SACConfig) -> Act:
    """The mean actions of N actors; ``widths``: components of an observation and of an action."""
    import torch

    from icrl_dist.experts.sac.stacked import Shape

    return functools.partial(_mean, Shape((widths[0], *config.hidden, 2 * widths[1])), torch.from_numpy(actors))


def _mean(shape: Shape, actors: torch.Tensor, states: np.ndarray) -> np.ndarray:
    import torch

    from icrl_dist.experts.sac.stacked import outputs

    mean: np.ndarray = outputs(shape, actors, torch.from_numpy(states.copy()))[..., : shape.sizes[-1] // 2].tanh().numpy()
    return mean


class MeanPolicy:
    """Actors of B environments, one per row; they act by their mean actions."""

    def __init__(self, act: Act) -> None:
        self._act = act

    def act(self, observation: Float32[np.ndarray, "B S"], u: np.ndarray) -> Float32[np.ndarray, "B A"]:
        """The mean action of each actor."""
        mean: Float32[np.ndarray, "B A"] = self._act(observation[:, None])[:, 0]
        return mean

    def observe(self, *transition: object) -> None:
        """Does nothing: the policy does not learn."""


class ExpertPolicy(MeanPolicy):
    """The experts of B variations, one per row."""

    def __init__(self, histories: Sequence[History], config: SACConfig) -> None:
        super().__init__(_mean_actions(histories, config))


class ScriptedPolicy:
    """A problem's scripted policy in one batch of environments, whose true states it reads."""

    def __init__(self, problem: Problem, env: Batch) -> None:
        self._problem, self._env = problem, env

    def act(self, observation: Float32[np.ndarray, "B S"], u: np.ndarray) -> Float32[np.ndarray, "B A"]:
        """The actions in the true states; ``observation`` is not used."""
        truth: np.ndarray = self._env.truth  # type: ignore[attr-defined]  # of problems with a scripted policy
        return scripted_actions(self._problem, truth)

    def observe(self, *transition: object) -> None:
        """Does nothing: the policy does not learn."""
