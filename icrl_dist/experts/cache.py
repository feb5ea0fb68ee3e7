"""Histories of SAC experts, and where they are kept: by what they are of, so that nobody makes them twice."""

from __future__ import annotations

import dataclasses
import hashlib
import logging
from importlib import metadata
from pathlib import Path
from typing import Literal, get_args

import msgpack
import numpy as np
from jaxtyping import Float32

from icrl_dist import version
from icrl_dist.config.sac import SACConfig
from icrl_dist.storage.checkpoint import Checkpoint, load_checkpoint, save_checkpoint
from icrl_dist.storage.files import StoreError
from icrl_dist.stream import wire
from icrl_dist.types import Variation

_log = logging.getLogger(__name__)

KEPT = 200
"""Episodes of a history, evenly spaced over the training; all, if there are fewer or more are asked for."""
LED = 8
"""Further episodes that the variation's own expert leads."""

Trainer = Literal["lockstep", "stable-baselines3", "lockstep, cuda"]
"""Who trains an expert, and where: each has its own last digits, and so its own experts."""

_VERSIONS = ("dm-control", "metaworld", "mujoco", "stable-baselines3", "torch")
_CODE = ("experts/", "problems/", "rollout/recorder.py", "config/sac.py", "training/optimizers.py")


@dataclasses.dataclass(frozen=True, eq=False)
class History:
    """E episodes of one expert's training, what the expert would have done in them, and the expert."""

    actions: Float32[np.ndarray, "E H A"]
    observations: Float32[np.ndarray, "E H+1 S"]
    rewards: Float32[np.ndarray, "E H"]
    adversary: Float32[np.ndarray, "E H F"]
    labels: Float32[np.ndarray, "E H A"]
    """The right action at each of the first H states: the expert's mean; in Meta-World the scripted policy's."""
    led_actions: Float32[np.ndarray, "G H A"]
    """G further episodes, which windows are cut from (zeta of eq. 6): in each the expert acted, without chance of its own."""
    led_observations: Float32[np.ndarray, "G H+1 S"]
    led_rewards: Float32[np.ndarray, "G H"]
    led_labels: Float32[np.ndarray, "G H A"]
    """The right action at each of their first H states."""
    actor: Float32[np.ndarray, " P"]
    """The expert's parameters, as ``algos.stacked.Shape`` lays them out."""

    def arrays(self) -> dict[str, np.ndarray]:
        """By name, as they are kept."""
        return {item.name: getattr(self, item.name) for item in dataclasses.fields(self)}


def own_seed(variation: Variation, seed: int) -> int:
    """The seed of a variation's expert in a run with this one: nothing of it depends on its company."""
    return int.from_bytes(hashlib.sha256(msgpack.packb([wire.from_variation(variation), seed])).digest()[:16])


def episodes(horizon: int, config: SACConfig) -> int:
    """Episodes of an expert's whole training, ``horizon`` steps each."""
    return max(1, config.steps // horizon)


def remembered(horizon: int, config: SACConfig, trials: int = 1) -> int:
    """Episodes that a history keeps if ``trials`` of them are needed: ``KEPT``, or all if that is too few."""
    return episodes(horizon, config) if trials > KEPT else min(KEPT, episodes(horizon, config))


def key(variation: Variation, horizon: int, config: SACConfig, seed: int, by: Trainer, trials: int = 1) -> str:
    """What a variation's history is kept under: all that decides it, physics and code included."""
    versions = [[name, metadata.version(name)] for name in _VERSIONS]
    numbers = [[f"sac.{item.name}", getattr(config, item.name)] for item in dataclasses.fields(config) if item.name != "cache"]
    whole = [wire.from_variation(variation), numbers, seed, by, versions, version.digest_of(_CODE)]
    whole += [remembered(horizon, config, trials), LED]
    return hashlib.sha256(msgpack.packb(whole)).hexdigest()


def kept(variation: Variation, horizon: int, config: SACConfig, seed: int, by: Trainer, trials: int = 1) -> History | None:
    """The history in the cache; None if it is not there, or damaged."""
    if not config.cache:
        return None
    path = file(config, key(variation, horizon, config, seed, by, trials))
    try:
        return History(**load_checkpoint(path).arrays) if path.exists() else None
    except (StoreError, TypeError) as error:
        _log.warning("made anew: %s", error)
        return None


def any_kept(variation: Variation, horizon: int, config: SACConfig, seed: int) -> History | None:
    """The same, whoever trained the expert, and whatever is kept of that."""
    found = (kept(variation, horizon, config, seed, by, trials) for by in get_args(Trainer) for trials in (1, KEPT + 1))
    return next((history for history in found if history is not None), None)


def file(config: SACConfig, name: str) -> Path:
    """Where it is kept."""
    return Path(config.cache).expanduser() / f"{name}.npz"


def keep(
    history: History, variation: Variation, horizon: int, config: SACConfig, seed: int, by: Trainer, trials: int = 1
) -> None:
    """For every later run that asks for the same."""
    if config.cache:
        path = file(config, key(variation, horizon, config, seed, by, trials))
        save_checkpoint(path, Checkpoint(history.arrays(), {"of": str(variation), "by": by}))
