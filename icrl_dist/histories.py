"""Histories of SAC experts, and where they are kept: by what they are of, so that nobody makes them twice."""

from __future__ import annotations

import dataclasses
import hashlib
import logging
from importlib import metadata
from pathlib import Path
from typing import Any

import msgpack
import numpy as np
from jaxtyping import Bool, Float32

from icrl_dist.files import Checkpoint, StoreError, load_checkpoint, save_checkpoint
from icrl_dist.games import SACConfig
from icrl_dist.stream import wire
from icrl_dist.types import Job, Params, Variation

_log = logging.getLogger(__name__)

KEPT = 200
"""Episodes of a history, evenly spaced over the training; all, if there are fewer."""
LED = 8
"""Further episodes that the variation's own expert leads, and as many that another's does."""

_PHYSICS = ("dm-control", "metaworld", "mujoco", "torch")


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
    """G further episodes, which stretches are cut from (zeta of eq. 6): in each an expert acted, without chance of its own."""
    led_observations: Float32[np.ndarray, "G H+1 S"]
    led_rewards: Float32[np.ndarray, "G H"]
    led_labels: Float32[np.ndarray, "G H A"]
    """The right action at each of their first H states."""
    led_wrong: Bool[np.ndarray, " G"]
    """Where another variation's expert acted: a guess that is wrong."""
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


def key(variation: Variation, config: SACConfig, seed: int) -> str:
    """What a variation's history is kept under: all that decides it, versions of the physics included."""
    versions = [[name, metadata.version(name)] for name in _PHYSICS]
    numbers = [[name, value] for name, value in settings(dataclasses.replace(config, cache=""))]
    whole = [wire.from_variation(variation), numbers, seed, versions, KEPT, LED]
    return hashlib.sha256(msgpack.packb(whole)).hexdigest()


def kept(variation: Variation, config: SACConfig, seed: int) -> History | None:
    """The history in the cache; None if it is not there, or damaged."""
    if not config.cache:
        return None
    path = file(config, key(variation, config, seed))
    try:
        return History(**load_checkpoint(path).arrays) if path.exists() else None
    except (StoreError, TypeError) as error:
        _log.warning("made anew: %s", error)
        return None


def file(config: SACConfig, name: str) -> Path:
    """Where it is kept."""
    return Path(config.cache).expanduser() / f"{name}.npz"


def keep(history: History, variation: Variation, config: SACConfig, seed: int) -> None:
    """For every later run that asks for the same."""
    if config.cache:
        save_checkpoint(file(config, key(variation, config, seed)), Checkpoint(history.arrays(), {"of": str(variation)}))
