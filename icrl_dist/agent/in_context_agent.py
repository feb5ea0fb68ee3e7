"""The deployed agent: act and observe.  It needs no environment of this package."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from numpy.typing import ArrayLike

from icrl_dist.agent.ood_score import Surprise
from icrl_dist.agent.trained_model import TrainedModel
from icrl_dist.config.run import ConfigError, Deployment
from icrl_dist.copies import CopiedWhole
from icrl_dist.interfaces import Actions
from icrl_dist.models.outcome_readout import OutcomeModel


class InContextAgent(CopiedWhole):
    """T_theta deployed in B environments at once, without weight updates.

    ``act`` samples a_h ~ T_theta(. | s_h, D_on); ``observe`` records the transition.  With the deployment
    rule ``paper`` (Algorithm 1) transitions join the context D_on at the end of the episode; with
    ``committed``, the default for a model trained on action windows, they join it at once.
    """

    def __init__(
        self,
        trained: TrainedModel,
        manifest: dict[str, Any],
        seed: int | None = None,
        deploy: Deployment | None = None,
        outcomes: OutcomeModel | None = None,
        threads: int | None = None,
    ) -> None:
        """Raises ConfigError for a deployment rule that the model was not trained for, and for ``threads`` below 1."""
        if threads is not None and threads < 1:
            raise ConfigError(f"threads = {threads}: use at least 1, or None for the number that torch is set to")
        self._trained, self.spec = trained, trained.spec
        self.outcomes = outcomes
        """The model's prediction of outcomes, for ``surprise``; None for a checkpoint that was not calibrated."""
        self.manifest = manifest
        """Origin of the agent: method, version, digests, seeds and library versions; in Dark Room also
        ``test_goals`` as ``[x, y]`` pairs, ``size`` and ``horizon``."""
        self.deploy: Deployment = deploy or trained.method.deployment(trained.run)
        """The deployment rule."""
        self.threads = threads
        """CPU threads of torch in the agent's methods; the process's own number is set again after each.  None: that number."""
        self._rng = np.random.default_rng(seed)
        self.reset_context()

    def reset_context(self, batch: int = 1) -> None:
        """Start with an empty context in ``batch`` environments, with the current weights of the model."""
        self._surprise = Surprise(self.outcomes, self.spec, batch) if self.outcomes else None
        watch = self._surprise.observe if self._surprise else None
        trained = self._trained
        self._policy: Any = trained.method.policy(trained.model, batch, trained.run.context, self.deploy, watch)
        self._batch = batch

    @property
    def model(self) -> torch.nn.Module:
        """The trained model."""
        return self._trained.model

    @property
    def surprise(self) -> Float[np.ndarray, " B"]:
        """OOD score of each environment: how unlike pretraining its last 100 transitions are.

        A high score means that the agent should not be trusted.  It is the loss of the model's predictions
        of outcomes, scaled by the losses in training tasks that the predictions were not fitted to: 0 is
        their median, 1 their 99th percentile.  It is 0 before the first transition, and only transitions
        after an ``act`` count.  Raises ConfigError for a checkpoint that was not calibrated.
        """
        if self._surprise is None:
            raise ConfigError(
                "surprise: this checkpoint was not calibrated: `icrl-dist train RUN --resume` calibrates the last one "
                "of a run, `icrl-dist export` calibrates the file that it writes"
            )
        return self._surprise.score()

    def act(self, obs: ArrayLike) -> Actions:
        """Actions for the observations ``obs (B, S)``: numbers ``(B,)``, or vectors in [-1, 1] ``(B, A)``.

        Raises ValueError for a batch of another shape.
        """
        states = self._shaped("obs", obs, np.float32, self.spec.observation)
        draws = self._rng.random((len(states), 1 if self.spec.discrete else self.spec.actions))
        with self._own_threads():
            return self._policy.act(states, draws)

    def observe(self, obs: ArrayLike, action: ArrayLike, reward: ArrayLike, next_obs: ArrayLike, done: ArrayLike) -> None:
        """Record one transition per environment: ``obs`` and ``next_obs (B, S)``, ``action`` as from ``act``, others ``(B,)``.

        ``done``: whether the episode ended.  Raises ValueError for another shape, or if only some of the
        episodes ended: all environments of a batch have the same horizon.
        """
        spec, size = self.spec, self.spec.observation
        ended = self._shaped("done", done, np.bool_)
        if ended.any() != ended.all():
            raise ValueError("done: the episodes of a batch must end together; use one agent per horizon")
        transition = (
            self._shaped("obs", obs, np.float32, size),
            self._shaped("action", action, *((np.int64,) if spec.discrete else (np.float32, spec.actions))),
            self._shaped("reward", reward, np.float32),
            self._shaped("next_obs", next_obs, np.float32, size),
        )
        with self._own_threads():
            self._policy.observe(*transition, bool(ended.all()))

    def distribution(self, states: ArrayLike, row: int = 0) -> Float[np.ndarray, "Q A"]:
        """T_theta(. | s, D) over discrete actions at states ``(Q, S)``, given the context of environment ``row``.

        The call does not change later actions.  Raises ValueError if actions are vectors.
        """
        if not self.spec.discrete:
            raise ValueError("distribution: the actions of this agent are vectors; use an agent with discrete actions")
        with self._own_threads():
            return self._policy.distribution(np.asarray(states, np.float32), row)

    def context(self, row: int = 0) -> tuple[np.ndarray, ...]:
        """The context D of environment ``row``: observations (T, S), actions (T), next observations (T, S) and rewards (T)."""
        return self._policy.context(row)

    @contextlib.contextmanager
    def _own_threads(self) -> Iterator[None]:
        before = torch.get_num_threads()
        if self.threads is not None:
            torch.set_num_threads(self.threads)
        try:
            yield
        finally:
            torch.set_num_threads(before)

    def _shaped(self, name: str, value: ArrayLike, dtype: type, *rest: int) -> np.ndarray:
        array: np.ndarray = np.asarray(value, dtype)
        shape = (self._batch, *rest)
        if array.shape != shape:
            raise ValueError(f"{name} has shape {array.shape}, expected {shape}; reset_context(batch=B) sets B")
        return array
