"""The trained model as a user deploys it: act, observe.  It depends on no environment."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from numpy.typing import ArrayLike

from icrl_dist.agent.ood_score import Surprise
from icrl_dist.agent.trained_model import TrainedModel
from icrl_dist.config.run import ConfigError, Deployment
from icrl_dist.interfaces import Actions
from icrl_dist.models.outcome_readout import OutcomeModel


class InContextAgent:
    """T_theta deployed in B environments at once, without weight updates.

    ``act`` samples a_h ~ T_theta(. | s_h, D_on); ``observe`` says what happened.  Deployed by
    ``paper`` (Algorithm 1) that joins the context D_on when the episode is done; by ``committed``,
    the default for a model trained on windows, at once.
    """

    def __init__(
        self,
        trained: TrainedModel,
        manifest: dict[str, Any],
        seed: int | None = None,
        deploy: Deployment | None = None,
        outcomes: OutcomeModel | None = None,
    ) -> None:
        """Raises ConfigError for a deployment that the model was not trained for."""
        self._trained, self.spec = trained, trained.spec
        self.outcomes = outcomes
        """What the model expects to happen, for ``surprise``; None if nobody asked it after training."""
        self.manifest = manifest
        """Where the agent comes from: method, version, digests, seeds, versions of the
        libraries; in Dark Room also ``test_goals`` as ``[x, y]`` pairs, ``size``, ``horizon``."""
        self.deploy: Deployment = deploy or trained.method.deployment(trained.run)
        """The rule by which the context grows."""
        self._rng = np.random.default_rng(seed)
        self.reset_context()

    def reset_context(self, batch: int = 1) -> None:
        """Forget everything and begin anew in ``batch`` environments, with the model's weights as they are now."""
        self._surprise = Surprise(self.outcomes, self.spec, batch) if self.outcomes else None
        watch = self._surprise.observe if self._surprise else None
        of = self._trained
        self._policy: Any = of.method.policy(of.model, batch, of.run.context, self.deploy, watch)
        self._batch = batch

    @property
    def model(self) -> torch.nn.Module:
        """The model that acts."""
        return self._trained.model

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
        states = self._shaped("obs", obs, np.float32, self.spec.observation)
        return self._policy.act(states, self._rng.random((len(states), 1 if self.spec.discrete else self.spec.actions)))

    def observe(self, obs: ArrayLike, action: ArrayLike, reward: ArrayLike, next_obs: ArrayLike, done: ArrayLike) -> None:
        """One transition of each environment: ``obs`` and ``next_obs (B, S)``, ``action`` as from ``act``, the others ``(B,)``.

        ``done`` says where the episode ended.  Raises ValueError for another shape, or if only
        some of the episodes ended: a batch shares one horizon.
        """
        spec, size = self.spec, self.spec.observation
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

    def distribution(self, states: ArrayLike, row: int = 0) -> Float[np.ndarray, "Q A"]:
        """T_theta(. | s, D) over discrete actions at states ``(Q, S)``, given the context of environment ``row``.

        What the agent would do anywhere, were it there: nothing that it does later is changed by asking.
        Raises ValueError for vectors of actions.
        """
        if not self.spec.discrete:
            raise ValueError(
                "distribution: this agent's actions are vectors; only a distribution over discrete ones can be listed"
            )
        return self._policy.distribution(np.asarray(states, np.float32), row)

    def context(self, row: int = 0) -> tuple[np.ndarray, ...]:
        """D of ``distribution``: observations (T, S), actions (T), next observations (T, S) and rewards (T)."""
        return self._policy.context(row)

    def _shaped(self, name: str, value: ArrayLike, dtype: type, *rest: int) -> np.ndarray:
        array: np.ndarray = np.asarray(value, dtype)
        shape = (self._batch, *rest)
        if array.shape != shape:
            raise ValueError(f"{name} has shape {array.shape}, expected {shape}; reset_context(batch=B) sets B")
        return array
