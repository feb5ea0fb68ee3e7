"""The trained model as a user deploys it: load, act, observe.  It knows no environment."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int

from icrl_dist.config import ConfigError, ContextConfig, parse
from icrl_dist.models.dpt import PretrainedTransformer, load_weights
from icrl_dist.rollout import InContextPolicy, sample
from icrl_dist.store import Checkpoint, StoreError, load_checkpoint
from icrl_dist.types import Spec


class InContextAgent:
    """T_theta deployed by Algorithm 1 in B environments at once, without weight updates.

    ``act`` samples a_h ~ T_theta(. | s_h, D_on); ``observe`` collects what happened, which
    joins the context D_on when the episode is done.
    """

    def __init__(
        self, model: PretrainedTransformer, manifest: dict[str, Any], context: ContextConfig, seed: int | None = None
    ) -> None:
        self.model = model.eval()
        self.manifest = manifest
        """Where the agent comes from: method, version, digests, seeds, versions of the
        libraries; in Dark Room also ``test_goals`` as ``[x, y]`` pairs, ``size``, ``horizon``."""
        self._context = context
        self._rng = np.random.default_rng(seed)
        self.reset_context()

    def reset_context(self, batch: int = 1) -> None:
        """Forget everything and begin anew in ``batch`` environments."""
        self._policy = InContextPolicy(self.model, batch, self._context)

    def act(self, obs: Float[np.ndarray, "B S"]) -> Int[np.ndarray, " B"]:
        """One action for each observation.  Raises ValueError for a batch of another shape."""
        obs = np.asarray(obs, np.float32)
        self._check("obs", obs, (self._policy.batch, self.model.spec.observation))
        return sample(self._policy.probabilities(obs), self._rng.random(len(obs)))

    def observe(
        self,
        obs: Float[np.ndarray, "B S"],
        action: Int[np.ndarray, " B"],
        reward: Float[np.ndarray, " B"],
        next_obs: Float[np.ndarray, "B S"],
        done: Bool[np.ndarray, " B"],
    ) -> None:
        """One transition of each environment; ``done`` where the episode ended.

        Raises ValueError for another shape, or if only some of the episodes ended: a batch
        shares one horizon.
        """
        batch, size = self._policy.batch, self.model.spec.observation
        columns = [np.asarray(obs, np.float32), np.asarray(action), np.asarray(reward, np.float32)]
        columns += [np.asarray(next_obs, np.float32), np.broadcast_to(np.asarray(done, bool), (batch,))]
        for name, column, shape in zip(
            ("obs", "action", "reward", "next_obs"), columns, ((batch, size), (batch,), (batch,), (batch, size)), strict=False
        ):
            self._check(name, column, shape)
        if columns[4].any() != columns[4].all():
            raise ValueError("done: the episodes of a batch end together; deploy unlike horizons in separate agents")
        self._policy.observe(columns[0], columns[1].astype(np.int64), columns[2], columns[3], bool(columns[4].all()))

    def _check(self, name: str, array: np.ndarray, shape: tuple[int, ...]) -> None:
        if array.shape != shape:
            raise ValueError(f"{name} has shape {array.shape}, expected {shape}; reset_context(batch=B) sets B")


def load_agent(what: str | Path, seed: int | None = None) -> InContextAgent:
    """The agent of a run folder (its newest version) or of one checkpoint file.

    Raises ConfigError if there is no such thing, StoreError if it was not written by this system.
    Loading executes no code from the file.
    """
    checkpoint = load_checkpoint(checkpoint_file(Path(what)))
    model, context = model_of(checkpoint)
    manifest = {k: v for k, v in checkpoint.manifest.items() if k != "spec"}
    return InContextAgent(model, manifest, context, seed)


def checkpoint_file(what: Path, version: int | None = None) -> Path:
    """The checkpoint at this path, or this (else the newest) version in a run folder."""
    if not what.is_dir():
        if what.is_file():
            return what
        raise ConfigError(f"{what}: no such run folder or checkpoint; `icrl-dist train demo` makes one in runs/demo")
    found = sorted((what / "checkpoints").glob("version-*.npz" if version is None else f"version-{version:04d}.npz"))
    if not found:
        raise ConfigError(f"{what}: holds no {'checkpoint' if version is None else f'version {version}'} yet")
    return found[-1]


def model_of(checkpoint: Checkpoint) -> tuple[PretrainedTransformer, ContextConfig]:
    """The model that a checkpoint holds, and how its context is kept at deployment.

    Raises StoreError if the arrays are not those of the model that the manifest describes.
    """
    try:
        run = parse(checkpoint.manifest["run"], "checkpoint")
        spec = spec_from(checkpoint.manifest["spec"])
        model = PretrainedTransformer(spec, run.model)
        load_weights(model, checkpoint.part("model"))
    except (KeyError, TypeError, ValueError, RuntimeError) as error:
        raise StoreError(f"checkpoint: not an agent of this version of icrl-dist ({' '.join(str(error).split())})") from None
    return model.eval(), run.context


def spec_from(fields: dict[str, Any]) -> Spec:
    """The inverse of ``dataclasses.asdict`` after a passage through JSON."""
    low, high = tuple(fields["low"]), tuple(fields["high"])
    return Spec(low, high, fields["actions"], fields["horizon"], fields["discrete"])
