"""Histories of SAC experts, and their cache: a key holds everything that determines a history, so none is trained twice.

The code of this package counts by ``EXPERTS_VERSION`` alone (docs/decisions/084-expert-cache-key.md).
"""

from __future__ import annotations

import dataclasses
import hashlib
import json
import logging
import tempfile
from collections.abc import Mapping
from importlib import metadata
from pathlib import Path
from typing import Literal, get_args

import msgpack
import numpy as np
from jaxtyping import Float32

from icrl_dist.config import plugins
from icrl_dist.config.sac import NOT_IN_TRAINING, SACConfig
from icrl_dist.experts.payloads import WINDOW_EPISODES
from icrl_dist.storage.checkpoint import Checkpoint, load_checkpoint, save_checkpoint
from icrl_dist.storage.files import StoreError
from icrl_dist.stream import wire
from icrl_dist.stream.schema import as_data
from icrl_dist.types import Variation

_log = logging.getLogger(__name__)

EXPERTS_VERSION = 1
"""Version of the code that decides the bytes of a history.  Raise it by 1 with every change after which the same settings
give other bytes: of the training, the draws, the recorded episodes, or the environments of a problem of this package.
Histories of another version are not found in a cache and are trained again."""

RECORDED_EPISODES = 200
"""Training episodes in a history, evenly spaced; all of them if there are fewer, or if a job needs more than this."""

Trainer = Literal["lockstep", "stable-baselines3", "lockstep, cuda"]
"""The implementation that trains an expert, and its device: their roundoff differs, so their experts are not the same."""

_LIBRARIES: dict[Trainer, tuple[str, ...]] = {
    "lockstep": ("numpy", "torch"),
    "lockstep, cuda": ("numpy", "torch"),
    "stable-baselines3": ("numpy", "torch", "stable-baselines3"),
}
"""The distributions that decide the bytes of a training; those of the environments are ``Problem.libraries``."""
_OF_CHECKPOINTS = frozenset({"checkpoints", "checkpoint_episodes"})
"""Settings that change a history only if there are several checkpoints."""


@dataclasses.dataclass(frozen=True, eq=False)
class Stored:
    """Arrays that are kept in one file of the cache; field names are also their names in the file."""

    def arrays(self) -> dict[str, np.ndarray]:
        """The arrays by name, as stored in a file."""
        return {item.name: getattr(self, item.name) for item in dataclasses.fields(self)}


@dataclasses.dataclass(frozen=True, eq=False)
class History(Stored):
    """E episodes of one expert's training with the expert's actions as labels, and the expert."""

    actions: Float32[np.ndarray, "E H A"]
    observations: Float32[np.ndarray, "E H+1 S"]
    rewards: Float32[np.ndarray, "E H"]
    adversary: Float32[np.ndarray, "E H F"]
    labels: Float32[np.ndarray, "E H A"]
    """The right action at each of the first H states: the expert's mean action, or that of the scripted policy."""
    window_actions: Float32[np.ndarray, "G H A"]
    """G episodes after training from which action windows (zeta of eq. 6) are cut: the expert acts by its mean actions."""
    window_observations: Float32[np.ndarray, "G H+1 S"]
    window_rewards: Float32[np.ndarray, "G H"]
    window_labels: Float32[np.ndarray, "G H A"]
    """The right action at each of their first H states."""
    actor: Float32[np.ndarray, " P"]
    """The expert's parameters, in the layout of ``experts.sac.stacked.Shape``."""


def expert_seed(variation: Variation, seed: int) -> int:
    """Seed of a variation's expert in a run with this seed; it does not depend on the other variations of a job."""
    return int.from_bytes(hashlib.sha256(msgpack.packb([wire.from_variation(variation), seed])).digest()[:16])


def training_episodes(horizon: int, config: SACConfig) -> int:
    """Number of episodes in an expert's training, ``horizon`` steps each."""
    return max(1, config.steps // horizon)


def recorded_episodes(horizon: int, config: SACConfig, trials: int = 1) -> int:
    """Number of episodes in a history for a job of ``trials`` trials; see ``RECORDED_EPISODES``."""
    episodes = training_episodes(horizon, config)
    return episodes if trials > RECORDED_EPISODES else min(RECORDED_EPISODES, episodes)


def key(
    variation: Variation,
    horizon: int,
    config: SACConfig,
    seed: int,
    trainer: Trainer,
    trials: int = 1,
    game: Mapping[str, object] | None = None,
) -> str:
    """Cache key of a history: the SHA-256 of all that determines it, as JSON with sorted keys.

    ``game``: of a robust policy, the settings of its training against an adversary that learns.
    Floats have their shortest exact form.  No name of a file, module or class is part of it.
    """
    task, adversary = variation.task, variation.adversary
    libraries = {*_LIBRARIES[trainer], *plugins.find("problems", task.kind).libraries}
    source = plugins.sources().get(f"problems/{task.kind}")
    left_out = NOT_IN_TRAINING | (_OF_CHECKPOINTS if config.checkpoints == 1 else frozenset())
    parts = {
        "experts_version": EXPERTS_VERSION,
        "task": [task.kind, dict(task.params)],
        "adversary": [adversary.kind, dict(adversary.params)],
        "sac": {name: value for name, value in as_data(config).items() if name not in left_out},
        "seed": seed,
        "trainer": trainer,
        "horizon": horizon,
        "recorded_episodes": recorded_episodes(horizon, config, trials),
        "window_episodes": WINDOW_EPISODES,
        "libraries": {name: metadata.version(name) for name in libraries},
        "plugin": [source.distribution, source.version] if source else None,
        **({} if game is None else {"game": dict(game)}),
    }
    return hashlib.sha256(json.dumps(parts, sort_keys=True, allow_nan=False).encode()).hexdigest()


def load(variation: Variation, horizon: int, config: SACConfig, seed: int, trainer: Trainer, trials: int = 1) -> History | None:
    """The history from the cache; None if it is missing or damaged."""
    if not config.cache:
        return None
    try:
        path = file(config, key(variation, horizon, config, seed, trainer, trials))
        return History(**load_checkpoint(path).arrays) if path.exists() else None
    except (StoreError, OSError, TypeError) as error:
        _log.warning("the history is made again: %s", error)
        return None


def load_any(variation: Variation, horizon: int, config: SACConfig, seed: int) -> History | None:
    """The history of any trainer, with any number of recorded episodes, from the cache; None if there is none."""
    keys = ((trainer, trials) for trainer in get_args(Trainer) for trials in (1, RECORDED_EPISODES + 1))
    found = (load(variation, horizon, config, seed, trainer, trials) for trainer, trials in keys)
    return next((history for history in found if history is not None), None)


def stored(variation: Variation, horizon: int, config: SACConfig, seed: int) -> bool:
    """Whether ``load_any`` finds a file; it is not read."""
    if not config.cache:
        return False
    keys = ((trainer, trials) for trainer in get_args(Trainer) for trials in (1, RECORDED_EPISODES + 1))
    return any(file(config, key(variation, horizon, config, seed, trainer, trials)).exists() for trainer, trials in keys)


def file(config: SACConfig, name: str) -> Path:
    """The file of the cache with this name.  Raises StoreError if the folder is in a home and this user has none."""
    try:
        return Path(config.cache).expanduser() / f"{name}.npz"
    except RuntimeError:
        raise StoreError(f"{config.cache}: this user has no home folder: set HOME, or sac.cache") from None


def unusable(config: SACConfig) -> str:
    """Why nothing can be stored in the cache, with the remedy; empty if something can, or if the run has no cache.

    Creates the folder of the cache.
    """
    if not config.cache:
        return ""
    try:
        folder = file(config, "").parent
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):  # permission bits are not enough (root, read-only mounts)
            return ""
    except StoreError as error:
        return str(error)
    except OSError as error:
        return f"{config.cache}: cannot be written ({error.strerror}): set sac.cache to a folder that you may write to"


def save(
    history: History, variation: Variation, horizon: int, config: SACConfig, seed: int, trainer: Trainer, trials: int = 1
) -> None:
    """Write the history to the cache, if the run has one.  Raises StoreError if that is impossible."""
    if config.cache:
        path = file(config, key(variation, horizon, config, seed, trainer, trials))
        save_checkpoint(path, Checkpoint(history.arrays(), {"of": str(variation), "by": trainer}))
