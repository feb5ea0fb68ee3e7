"""SAC experts of the variations of a continuous game, and the histories of how they came to be (appendix C.3).

What a variation is learned from: episodes of its expert's training, from the first random ones to
the last, and at every state of them the action of the expert that came of it.  Expert networks
never travel; histories and experts are kept where they were made, by what they are of, so that
nobody trains them twice.
"""

from __future__ import annotations

import dataclasses
import hashlib
import logging
import time
from collections.abc import Callable, Iterator, Sequence
from importlib import metadata
from pathlib import Path
from typing import Any, Protocol

import msgpack
import numpy as np
from jaxtyping import Float32

from icrl_dist import envs
from icrl_dist.envs.recorder import Recorder
from icrl_dist.files import Checkpoint, StoreError, load_checkpoint, save_checkpoint
from icrl_dist.games import SACConfig
from icrl_dist.stream import wire
from icrl_dist.types import Identity, Job, Params, Spec, Trajectory, Variation

_log = logging.getLogger(__name__)

KEPT = 200
"""Episodes of a history, evenly spaced over the training; all, if there are fewer."""
CHECKPOINT_S = 60.0
"""A training that is under way is written down so often; after a kill it goes on from there."""

_PHYSICS = ("dm-control", "metaworld", "mujoco", "torch")


class Tell(Protocol):
    """Hears how long work goes on; what is a ``note`` is worth a line of its own."""

    def __call__(self, text: str, note: bool = False) -> None: ...


def unheard(text: str, note: bool = False) -> None:
    """Nobody listens."""


@dataclasses.dataclass(frozen=True, eq=False)
class History:
    """E episodes of one expert's training, what the expert would have done in them, and the expert."""

    actions: Float32[np.ndarray, "E H A"]
    observations: Float32[np.ndarray, "E H+1 S"]
    rewards: Float32[np.ndarray, "E H"]
    adversary: Float32[np.ndarray, "E H F"]
    labels: Float32[np.ndarray, "E H A"]
    """The right action at each of the first H states: the expert's mean; in Meta-World the scripted policy's."""
    actor: Float32[np.ndarray, " P"]
    """The expert's parameters, as ``algos.stacked.Shape`` lays them out."""

    def arrays(self) -> dict[str, np.ndarray]:
        """By name, as they are kept."""
        return {item.name: getattr(self, item.name) for item in dataclasses.fields(self)}


def settings(config: SACConfig) -> Params:
    """The section as settings of a job."""
    return tuple((f"sac.{item.name}", getattr(config, item.name)) for item in dataclasses.fields(config))


def sac_of(job: Job) -> SACConfig:
    """The inverse of ``settings``."""
    given: dict[str, Any] = {item.name: job.setting(f"sac.{item.name}") for item in dataclasses.fields(SACConfig)}
    return SACConfig(**given)


def train_expert(job: Job, worker: str, tell: Tell = unheard) -> Iterator[Trajectory]:
    """Histories D^{i,k} of SAC experts of each variation, query states and labels (Algorithm 2, lines 8 to 12).

    All of a job's experts train together, in lockstep; they, and so the histories, are known when
    the last step is made.  Settings: those of ``settings``, ``queries`` a trajectory.  Raises
    RuntimeError for a variation whose simulation keeps breaking down.
    """
    found = _histories(job, sac_of(job), tell)
    queries = int(str(job.setting("queries")))
    for row, (task, variation) in enumerate(job.rows()):
        history = found[row]
        chosen = np.linspace(0, len(history.rewards) - 1, job.trials).round().astype(int)
        for trial, episode in enumerate(chosen.tolist()):
            identity = Identity(job.stage, job.round, task, variation, trial)
            asked = identity.rng(job.seed).integers(history.rewards.size, size=queries)
            place = np.unravel_index(asked, history.rewards.shape)
            yield Trajectory(
                identity=identity,
                variation=job.variation(identity),
                weights=job.weights,
                digest="",
                worker=worker,
                observations=history.observations[episode],
                actions=history.actions[episode],
                rewards=history.rewards[episode],
                adversary=history.adversary[episode],
                queries=history.observations[:, :-1][place],
                labels=history.labels[place],
                taken=np.zeros((0, history.labels.shape[-1]), np.float32),
                gained=np.zeros(0, np.float32),
                origin="expert",
            )


def key(variation: Variation, config: SACConfig, seed: int) -> str:
    """What a variation's history is kept under: all that decides it, versions of the physics included."""
    versions = [[name, metadata.version(name)] for name in _PHYSICS]
    numbers = [[name, value] for name, value in settings(dataclasses.replace(config, cache=""))]
    whole = [wire.from_variation(variation), numbers, seed, versions, KEPT]
    return hashlib.sha256(msgpack.packb(whole)).hexdigest()


def kept(variation: Variation, config: SACConfig, seed: int) -> History | None:
    """The history in the cache; None if it is not there, or damaged."""
    if not config.cache:
        return None
    path = _file(config, key(variation, config, seed))
    try:
        return History(**load_checkpoint(path).arrays) if path.exists() else None
    except (StoreError, TypeError) as error:
        _log.warning("made anew: %s", error)
        return None


def _file(config: SACConfig, name: str) -> Path:
    return Path(config.cache).expanduser() / f"{name}.npz"


def _histories(job: Job, config: SACConfig, tell: Tell) -> list[History]:
    """Of each of the job's variations: from the cache if all are there, else of a training of all of them.

    The batch belongs to the job, as everywhere: experts that trained in other company differ in
    their last digits.
    """
    found = [kept(variation, config, job.seed) for variation in job.variations]
    whole = [history for history in found if history is not None]
    if len(whole) == len(found):
        saved = f"{len(whole) * config.steps:,} steps of SAC saved"
        tell(f"{job.label}: {len(whole)} experts from the cache, {saved}", note=True)
        return whole
    made = _train(job, config, tell)
    if config.cache:
        for variation, history in zip(job.variations, made, strict=True):
            save_checkpoint(
                _file(config, key(variation, config, job.seed)), Checkpoint(history.arrays(), {"of": str(variation)})
            )
    return made


def _train(job: Job, config: SACConfig, tell: Tell) -> list[History]:
    from icrl_dist.algos.sac_batch import SACBatch, train

    names = [key(variation, config, job.seed) for variation in job.variations]
    part = _file(config, "part-" + hashlib.sha256("".join(names).encode()).hexdigest()) if config.cache else None
    recorder = Recorder(envs.batch(job.variations), max(1, config.steps // envs.spec(job.variations[0].task).horizon), KEPT)
    state = _resumed(part, recorder) if part is not None and part.exists() else None
    written = time.monotonic()

    def progress(experts: SACBatch, returns: np.ndarray) -> None:
        nonlocal written
        mean = f"mean return {returns.mean():.0f}"
        tell(f"{len(names)} experts at {experts.steps:,} of {config.steps:,} steps, {mean}")
        if part is not None and time.monotonic() - written >= CHECKPOINT_S:
            arrays = {f"state/{name}": value for name, value in experts.state().items()}
            arrays |= {f"episodes/{name}": value for name, value in recorder.state().items()}
            save_checkpoint(part, Checkpoint(arrays, {}))
            written = time.monotonic()

    seed = int(Identity(job.stage, job.round, job.task, job.first, 0).rng(job.seed).integers(2**31))
    experts = train(recorder, config, recorder.episodes * recorder.spec.horizon, seed, progress, state=state)
    columns = recorder.columns()
    truths, whole = columns.pop("truths", None), columns.pop("whole")
    if truths is None:
        seen = columns["observations"][:, :, :-1]
        columns["labels"] = experts.act(seen.reshape(len(names), -1, seen.shape[-1]), None, deterministic=True)
    else:
        columns["labels"] = _scripted(truths)
    columns["labels"] = columns["labels"].reshape(columns["actions"].shape)
    actors = experts.arrays["actor"].cpu().numpy()
    for row, variation in enumerate(job.variations):
        if not whole[row].any():
            raise RuntimeError(f"{variation}: its simulation broke down in every episode; leave it out, or push it less")
    made = [
        History(**{name: column[row][whole[row]] for name, column in columns.items()}, actor=actors[row])
        for row in range(len(names))
    ]
    if part is not None:
        part.unlink(missing_ok=True)
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


def _scripted(truths: np.ndarray) -> Float32[np.ndarray, "N A"]:
    from icrl_dist.envs.metaworld import expert

    return expert(truths.reshape(-1, truths.shape[-1]).astype(np.float64))


class ExpertPolicy:
    """The experts of B variations, each in its row: means of their actions, by ``History.actor``."""

    def __init__(self, histories: Sequence[History], spec: Spec, config: SACConfig) -> None:
        import torch

        from icrl_dist.algos.stacked import Shape, outputs

        shape = Shape((spec.observation, *config.hidden, 2 * spec.actions))
        actors = torch.from_numpy(np.stack([history.actor for history in histories]))
        self._outputs: Callable[[Any], Any] = lambda seen: outputs(shape, actors, torch.from_numpy(seen[:, None].copy()))
        self._actions = spec.actions

    def act(self, observation: Float32[np.ndarray, "B S"], u: np.ndarray) -> Float32[np.ndarray, "B A"]:
        """The mean action of each expert."""
        mean: np.ndarray = self._outputs(observation)[:, 0, : self._actions].tanh().numpy()
        return mean

    def observe(self, *transition: object) -> None:
        """Nothing to learn."""


class ScriptedPolicy:
    """Meta-World's scripted policy, which is told the true states of the environment that it meets."""

    def meet(self, env: Any) -> None:
        """Before the first ``act``."""
        self._env = env

    def act(self, observation: Float32[np.ndarray, "B S"], u: np.ndarray) -> Float32[np.ndarray, "B A"]:
        """What it does in the true state, whatever is shown."""
        from icrl_dist.envs.metaworld import expert

        return expert(self._env.truth)

    def observe(self, *transition: object) -> None:
        """Nothing to learn."""
