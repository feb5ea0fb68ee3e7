"""The trained model as a user deploys it: load, act, observe.  It knows no environment."""

from __future__ import annotations

from collections.abc import Callable
from importlib import resources
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike

from icrl_dist.agent.ood_score import Surprise, calibrate
from icrl_dist.config.run import ConfigError, ContextConfig, Deployment, default_deployment, parse
from icrl_dist.models.dpt import PretrainedTransformer, load_weights
from icrl_dist.models.outcome_readout import OutcomeModel
from icrl_dist.rollout.deployment import Actions, in_context
from icrl_dist.storage.checkpoint import Checkpoint, load_checkpoint, newest_version, version_file
from icrl_dist.storage.files import StoreError
from icrl_dist.types import Spec

_AGENTS = Path(str(resources.files("icrl_dist.agent.shipped")))
SHIPPED = tuple(sorted(file.stem for file in _AGENTS.glob("*.npz")))
"""Agents that come with the package (docs/results/engine.md says how each was made)."""


class InContextAgent:
    """T_theta deployed in B environments at once, without weight updates.

    ``act`` samples a_h ~ T_theta(. | s_h, D_on); ``observe`` says what happened.  Deployed by
    ``paper`` (Algorithm 1) that joins the context D_on when the episode is done; by ``committed``,
    the default for a model trained on windows, at once.
    """

    def __init__(
        self,
        model: PretrainedTransformer,
        manifest: dict[str, Any],
        context: ContextConfig,
        seed: int | None = None,
        deploy: Deployment | None = None,
        outcomes: OutcomeModel | None = None,
    ) -> None:
        """Raises ConfigError for a deployment that the model was not trained for."""
        self.model = model.eval()
        self.outcomes = outcomes
        """What the model expects to happen, for ``surprise``; None if nobody asked it after training."""
        self.manifest = manifest
        """Where the agent comes from: method, version, digests, seeds, versions of the
        libraries; in Dark Room also ``test_goals`` as ``[x, y]`` pairs, ``size``, ``horizon``."""
        self.deploy: Deployment = deploy or default_deployment(model.config)
        """The rule by which the context grows."""
        self._context = context
        self._rng = np.random.default_rng(seed)
        self.reset_context()

    def reset_context(self, batch: int = 1) -> None:
        """Forget everything and begin anew in ``batch`` environments, with the model's weights as they are now."""
        self._surprise = Surprise(self.outcomes, self.model.spec, batch) if self.outcomes else None
        watch = self._surprise.observe if self._surprise else None
        self._policy = in_context(self.model, batch, self._context, self.deploy, watch)

    @property
    def surprise(self) -> Float[np.ndarray, " B"]:
        """How unlike pretraining each environment has been over its last 100 transitions: when not to trust the agent.

        From the loss of the model's own predictions of what its actions bring, in training tasks
        kept apart from the fit of these predictions: 0 is their median, 1 what one stretch of time
        in a hundred reaches there.  0 before the first transition; only transitions after an
        ``act`` count.  Raises ConfigError for a checkpoint that was not calibrated.
        """
        if self._surprise is None:
            raise ConfigError(
                "surprise: this checkpoint was not calibrated, as the last one of a run is: "
                "`icrl-dist train RUN --resume` calibrates a run's, `icrl-dist export` the file that it makes"
            )
        return self._surprise.now()

    def act(self, obs: ArrayLike) -> Actions:
        """One action for each observation of ``obs (B, S)``: numbers ``(B,)``, or vectors in [-1, 1] ``(B, A)``.

        Raises ValueError for a batch of another shape.
        """
        states = self._shaped("obs", obs, np.float32, self.model.spec.observation)
        return self._policy.act(states, self._rng.random((len(states), self.model.reads.numbers)))

    def observe(self, obs: ArrayLike, action: ArrayLike, reward: ArrayLike, next_obs: ArrayLike, done: ArrayLike) -> None:
        """One transition of each environment: ``obs`` and ``next_obs (B, S)``, ``action`` as from ``act``, the others ``(B,)``.

        ``done`` says where the episode ended.  Raises ValueError for another shape, or if only
        some of the episodes ended: a batch shares one horizon.
        """
        spec, size = self.model.spec, self.model.spec.observation
        ended = self._shaped("done", done, np.bool_)
        if ended.any() != ended.all():
            raise ValueError("done: the episodes of a batch end together; deploy unlike horizons in separate agents")
        self._policy.observe(
            self._shaped("obs", obs, np.float32, size),
            self._shaped("action", action, *((np.int64,) if spec.discrete else (np.float32, spec.actions))),
            self._shaped("reward", reward, np.float32),
            self._shaped("next_obs", next_obs, np.float32, size),
            bool(ended.all()),
        )

    def law(self, states: ArrayLike, row: int = 0) -> Float[np.ndarray, "Q A"]:
        """T_theta(. | s, D) over discrete actions at states ``(Q, S)``, given the context of environment ``row``.

        What the agent would do anywhere, were it there: nothing that it does later is changed by asking.
        Raises ValueError for vectors of actions.
        """
        if not self.model.spec.discrete:
            raise ValueError("law: this agent's actions are vectors; only a law over discrete ones can be listed")
        return self._policy.law(np.asarray(states, np.float32), row)

    def context(self, row: int = 0) -> tuple[np.ndarray, ...]:
        """D of ``law``: observations (T, S), actions (T), next observations (T, S) and rewards (T)."""
        return self._policy.context(row)

    def _shaped(self, name: str, value: ArrayLike, dtype: type, *rest: int) -> np.ndarray:
        array: np.ndarray = np.asarray(value, dtype)
        shape = (self._policy.batch, *rest)
        if array.shape != shape:
            raise ValueError(f"{name} has shape {array.shape}, expected {shape}; reset_context(batch=B) sets B")
        return array


def load_agent(what: str | Path, seed: int | None = None, deploy: Deployment | None = None) -> InContextAgent:
    """The agent of a run folder (its newest version), of one checkpoint file, or a shipped one by its name.

    ``load_agent("darkroom")`` works at once; a run folder of such a name is ``"./darkroom"``.

    Raises ConfigError if there is no such thing or it was not trained to be deployed so, StoreError
    if it was not written by this system.  Loading executes no code from the file.
    """
    checkpoint = load_checkpoint(shipped(what) if what in SHIPPED else checkpoint_file(Path(what)))
    model, context = model_of(checkpoint)
    manifest = {k: v for k, v in checkpoint.manifest.items() if k != "spec"}
    return InContextAgent(model, manifest, context, seed, deploy, outcomes_of(checkpoint))


def shipped(name: str | Path) -> Path:
    """The checkpoint of an agent that comes with the package.  Raises ConfigError if there is none."""
    if name not in SHIPPED:
        raise ConfigError(f"--pretrained {name}: no agent of that name is shipped; there are {', '.join(SHIPPED)}")
    return _AGENTS / f"{name}.npz"


def slim(checkpoint: Checkpoint) -> Checkpoint:
    """What deployment needs of a checkpoint: the weights and where they come from, not the optimizer or the dataset's list."""
    manifest = {key: value for key, value in checkpoint.manifest.items() if key != "dataset"}
    return Checkpoint({k: v for k, v in checkpoint.arrays.items() if k.startswith(("model/", "outcomes/"))}, manifest)


def is_slim(path: Path) -> bool:
    """Whether a file is an agent as ``slim`` leaves it: to replace it loses nothing that training needs."""
    try:
        checkpoint = load_checkpoint(path)
    except StoreError:
        return False
    kept = slim(checkpoint)
    return kept.arrays.keys() == checkpoint.arrays.keys() and kept.manifest.keys() == checkpoint.manifest.keys()


def calibrated(checkpoint: Checkpoint, progress: Callable[[int], None] = lambda episodes: None) -> Checkpoint:
    """The checkpoint with what its model expects to happen (``surprise.calibrate``); as it is if it has that already."""
    if checkpoint.part("outcomes"):
        return checkpoint
    run = parse(checkpoint.manifest["run"], "checkpoint")
    outcomes = calibrate(run, model_of(checkpoint)[0], progress).arrays()
    arrays = {**checkpoint.arrays, **{f"outcomes/{name}": value for name, value in outcomes.items()}}
    return Checkpoint(arrays, checkpoint.manifest)


def checkpoint_file(what: Path, version: int | None = None) -> Path:
    """The checkpoint at this path, or this (else the newest) version in a run folder."""
    if not what.is_dir():
        if what.is_file():
            return what
        raise ConfigError(f"{what}: no such run folder or checkpoint; `icrl-dist train demo` makes one in runs/demo")
    found = version_file(what, newest_version(what) if version is None else version)
    if not found.is_file():
        raise ConfigError(f"{what}: holds no {'checkpoint' if version is None else f'version {version}'} yet")
    return found


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


def outcomes_of(checkpoint: Checkpoint) -> OutcomeModel | None:
    """What the checkpoint's model expects to happen; None if it was not calibrated.

    Raises StoreError if its arrays are others than a calibrated checkpoint's.
    """
    try:
        return OutcomeModel.of(checkpoint.part("outcomes"))
    except TypeError as error:
        raise StoreError(f"checkpoint: not calibrated by this version of icrl-dist ({error})") from None


def spec_from(fields: dict[str, Any]) -> Spec:
    """The inverse of ``dataclasses.asdict`` after a passage through JSON."""
    low, high = tuple(fields["low"]), tuple(fields["high"])
    return Spec(low, high, fields["actions"], fields["horizon"], fields["discrete"])
