"""SAC experts of the variations of a continuous game, and the histories of how they came to be (appendix C.3).

What a variation is learned from: episodes of its expert's training, from the first random ones to
the last, and at every state of them the action of the expert that came of it.  Expert networks
never travel; histories and experts are kept where they were made, by what they are of, so that
nobody trains them twice.  An expert is seeded by its variation: in any company it becomes the same.
"""

from __future__ import annotations

import hashlib
import logging
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float32

from icrl_dist.config.sac import SACConfig
from icrl_dist.experts.cache import History, Trainer, episodes, file, keep, kept, key, own_seed, remembered
from icrl_dist.experts.delivery import Act, delivered, labelled, lead, scripted
from icrl_dist.experts.payloads import ExpertHistories
from icrl_dist.interfaces import Batch, Problem, Progress, no_progress
from icrl_dist.rollout.recorder import Recorder
from icrl_dist.storage.checkpoint import Checkpoint, load_checkpoint, save_checkpoint
from icrl_dist.storage.files import StoreError
from icrl_dist.types import Job, Trajectory, Variation

if TYPE_CHECKING:
    from icrl_dist.experts.sac.batched import Backend, SACBatch

_log = logging.getLogger(__name__)

CHECKPOINT_S = 60.0
"""A training that is under way is written down so often; after a kill it goes on from there."""


def train_expert(job: Job, problem: Problem, worker: str, progress: Progress = no_progress) -> Iterator[Trajectory]:
    """Histories D^{i,k} of SAC experts of each variation, query states and labels (Algorithm 2, lines 8 to 12).

    All of a job's experts train together, in lockstep; they, and so the histories, are known when
    the last step is made.  Settings: those of ``settings``; ``queries`` a trajectory; ``windows``
    a trajectory, of ``window`` states, a share ``decoy_fraction`` of them led by another task's expert.  Raises
    RuntimeError for a variation whose simulation keeps breaking down.
    """
    payload = job.payload
    assert isinstance(payload, ExpertHistories)
    found = _histories(job, problem, payload.sac, progress)
    yield from delivered(job, problem, payload.labelling, found, worker, _by_actors(found, payload.sac))


def _histories(job: Job, problem: Problem, config: SACConfig, progress: Progress) -> list[History]:
    """Of each of the job's variations: from the cache, and of a training of those that are not there."""
    by, horizon = trained_by(len(job.variations)), problem.spec_of(job.variations[0].task).horizon
    there = {variation: kept(variation, horizon, config, job.seed, _trainer(by), job.trials) for variation in job.variations}
    found = {variation: history for variation, history in there.items() if history is not None}
    missing = [variation for variation in there if variation not in found]
    if found:
        progress(
            f"{job.label}: {len(found)} experts from the cache, {len(found) * config.steps:,} steps of SAC saved", note=True
        )
    if missing:
        for variation, history in zip(missing, _train(job, problem, missing, by, config, progress), strict=True):
            keep(history, variation, horizon, config, job.seed, _trainer(by), job.trials)
            found[variation] = history
    return [found[variation] for variation in job.variations]


def trained_by(experts: int) -> Backend:
    """stable-baselines3, the reference, trains a job's expert that is alone; several train in lockstep, and one on a GPU."""
    from icrl_dist.experts.sac.batched import pick

    return "stable-baselines3" if experts == 1 and pick("auto").type == "cpu" else "lockstep"


def _trainer(by: Backend) -> Trainer:
    from icrl_dist.experts.sac.batched import pick

    return "lockstep, cuda" if by == "lockstep" and pick("auto").type == "cuda" else by


def _train(
    job: Job, problem: Problem, variations: Sequence[Variation], by: Backend, config: SACConfig, progress: Progress
) -> list[History]:
    from icrl_dist.experts.sac.batched import train

    horizon = problem.spec_of(variations[0].task).horizon
    names = [key(variation, horizon, config, job.seed, _trainer(by), job.trials) for variation in variations]
    part = file(config, "part-" + hashlib.sha256("".join(names).encode()).hexdigest()) if config.cache else None
    env, seeds = problem.batch(variations), [own_seed(variation, job.seed) for variation in variations]
    recorder = Recorder(env, episodes(horizon, config), remembered(horizon, config, job.trials))
    state = _resumed(part, recorder) if part is not None and part.exists() else None
    written = time.monotonic()

    def report(experts: SACBatch, returns: np.ndarray) -> None:
        nonlocal written
        mean = f"mean return {returns.mean():.0f}"
        progress(f"{len(names)} experts at {experts.steps:,} of {config.steps:,} steps, {mean}", reached=experts.steps)
        if part is not None and time.monotonic() - written >= CHECKPOINT_S:
            arrays = {f"state/{name}": value for name, value in experts.state().items()}
            arrays |= {f"episodes/{name}": value for name, value in recorder.state().items()}
            save_checkpoint(part, Checkpoint(arrays, {}))
            written = time.monotonic()

    experts = train(recorder, config, recorder.episodes * recorder.spec.horizon, seeds, report, state=state, backend=by)
    columns, led = labelled(recorder.columns(), problem, experts.act), lead(env, problem, experts.act, seeds, range(env.batch))
    made = assembled(job, variations, columns, led, experts.arrays["actor"].cpu().numpy(), progress)
    if part is not None:
        part.unlink(missing_ok=True)
    return made


def assembled(
    job: Job,
    variations: Sequence[Variation],
    columns: dict[str, np.ndarray],
    led: dict[str, np.ndarray],
    actors: np.ndarray,
    progress: Progress,
) -> list[History]:
    """The history of each of these of the job's variations, without the episodes that broke down.

    Raises RuntimeError for a variation of which nothing is left.
    """
    parts, made = {"": columns, "led_": led}, []
    for row, variation in enumerate(variations):
        whole = {prefix: of["whole"][row] for prefix, of in parts.items()}
        lost = sum(int((~one).sum()) for one in whole.values())
        if lost:
            progress(f"{job.label}: {lost} episodes of {variation} broke down, and are left out", note=True)
        if not all(one.any() for one in whole.values() if len(one)):
            raise RuntimeError(f"{variation}: its simulation breaks down in every episode; leave it out, or push it less")
        taken = {
            prefix + name: column[row][whole[prefix]]
            for prefix, of in parts.items()
            for name, column in of.items()
            if name != "whole"
        }
        made.append(History(**taken, actor=actors[row]))
    return made


def _resumed(part: Path, recorder: Recorder) -> dict[str, np.ndarray] | None:
    """The state of a training that was under way; None if it cannot be read."""
    try:
        stored = load_checkpoint(part)
        recorder.load(stored.part("episodes"))
        return stored.part("state")
    except (StoreError, KeyError) as error:
        _log.warning("this training begins anew: %s", error)
        return None


def _by_actors(found: Sequence[History], config: SACConfig) -> Act:
    """What these experts do, by ``History.actor``."""
    import torch

    from icrl_dist.experts.sac.stacked import Shape, outputs

    sizes = found[0].observations.shape[-1], *config.hidden, 2 * found[0].actions.shape[-1]
    shape, actors = Shape(sizes), torch.from_numpy(np.stack([history.actor for history in found]))

    def act(seen: np.ndarray) -> np.ndarray:
        mean: np.ndarray = outputs(shape, actors, torch.from_numpy(seen.copy()))[..., : sizes[-1] // 2].tanh().numpy()
        return mean

    return act


class ExpertPolicy:
    """The experts of B variations, each in its row: means of their actions."""

    def __init__(self, histories: Sequence[History], config: SACConfig) -> None:
        self._act = _by_actors(histories, config)

    def act(self, observation: Float32[np.ndarray, "B S"], u: np.ndarray) -> Float32[np.ndarray, "B A"]:
        """The mean action of each expert."""
        mean: Float32[np.ndarray, "B A"] = self._act(observation[:, None])[:, 0]
        return mean

    def observe(self, *transition: object) -> None:
        """Nothing to learn."""


class ScriptedPolicy:
    """A problem's scripted policy, which reads the true states of one batch of environments."""

    def __init__(self, problem: Problem, env: Batch) -> None:
        self._problem, self._env = problem, env

    def act(self, observation: Float32[np.ndarray, "B S"], u: np.ndarray) -> Float32[np.ndarray, "B A"]:
        """Its actions in the true states, whatever is observed."""
        truth: np.ndarray = self._env.truth  # type: ignore[attr-defined]  # of problems with a scripted policy
        return scripted(self._problem, truth)

    def observe(self, *transition: object) -> None:
        """Nothing to learn."""
