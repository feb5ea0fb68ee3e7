"""The deployed agent: act and observe.  It needs no environment of this package."""

from __future__ import annotations

import dataclasses
import threading
from typing import TYPE_CHECKING, Any, get_args

import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike

from icrl_dist import arrays
from icrl_dist.agent.ood_score import Surprise
from icrl_dist.agent.threads import torch_threads, whole_or_none
from icrl_dist.agent.trained_model import TrainedModel
from icrl_dist.config.run import ConfigError, Deployment
from icrl_dist.config.sections import Decoder
from icrl_dist.config.toml import nearest
from icrl_dist.copies import CopiedWhole
from icrl_dist.interfaces import Actions
from icrl_dist.models.compiled import Unusable, library
from icrl_dist.models.outcome_readout import OutcomeModel

if TYPE_CHECKING:
    import torch


class InContextAgent(CopiedWhole):
    """T_theta deployed in B environments at once, without weight updates.

    ``act`` samples a_h ~ T_theta(. | s_h, D_on); ``observe`` records the transition.  With the deployment
    rule ``paper`` (Algorithm 1) transitions join the context D_on at the end of the episode; with
    ``committed``, the default for a model trained on action windows, and with ``growing``, that for Algorithm
    Distillation, they join it at once.

    Arguments may be arrays, lists or torch tensors; they are copied, and so is what a method returns.  A copy
    (``copy.deepcopy``, ``pickle``) has the same context and draws the same actions.  Calls from several threads are done
    one after the other.
    """

    def __init__(
        self,
        trained: TrainedModel,
        manifest: dict[str, Any],
        seed: int | None = None,
        deploy: Deployment | None = None,
        outcomes: OutcomeModel | None = None,
        threads: int | None = None,
        decoder: Decoder = "auto",
    ) -> None:
        """Raises ConfigError for a rule that the model was not trained for, ``threads`` below 1, ``seed`` below 0, and for a
        ``decoder`` that is unknown or missing here.
        """
        seed = whole_or_none("seed", seed, 0)
        _check_decoder(decoder)
        self._trained, self.spec = trained, trained.spec
        self.outcomes = outcomes
        """The model's prediction of outcomes, for ``surprise``; None for a checkpoint that was not calibrated."""
        self.manifest = manifest
        """Origin of the agent: method, version, digests, seeds and library versions; in Dark Room also
        ``test_goals`` as ``[x, y]`` pairs, ``size`` and ``horizon``."""
        self.deploy: Deployment = trained.method.deployment(trained.run) if deploy is None else deploy
        """The deployment rule."""
        self.threads = whole_or_none("threads", threads, 1)
        """CPU threads of torch in the agent's methods; the process's own number is set again after each.  None: that number."""
        self._context = dataclasses.replace(trained.run.context, decoder=decoder)
        self._rng = np.random.default_rng(seed)
        self._one_call = threading.RLock()
        self.reset_context()

    def reset_context(self, batch: int = 1) -> None:
        """Start with an empty context in ``batch`` environments, with the current weights of the model.

        Raises ValueError for a ``batch`` below 1.
        """
        batch = arrays.whole("batch", batch, 1)
        with self._one_call:
            model = self._trained.to_deploy(self._context)  # imports torch if it is needed, so before torch_threads
            with torch_threads(self.threads):
                self._surprise = Surprise(self.outcomes, self.spec, batch) if self.outcomes else None
                watch = self._surprise.observe if self._surprise else None
                self._policy: Any = self._trained.method.policy(model, batch, self._context, self.deploy, watch)
                self._batch = batch

    def __getstate__(self) -> dict[str, Any]:
        return {name: value for name, value in self.__dict__.items() if name != "_one_call"}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state, _one_call=threading.RLock())

    @property
    def model(self) -> torch.nn.Module:
        """The trained model, in torch.  The first use imports torch and builds it; later contexts use its weights."""
        with self._one_call:
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
        with self._one_call:
            return self._surprise.score()

    def act(self, obs: ArrayLike) -> Actions:
        """Actions for the observations ``obs (B, S)``: numbers ``(B,)``, or vectors in [-1, 1] ``(B, A)``.

        Raises ValueError for another shape or type, and for nan, infinity and numbers beyond 1e12.
        """
        with self._one_call, torch_threads(self.threads):
            states = arrays.floats("obs", obs, (self._batch, self.spec.observation), self._shape_remedy)
            draws = self._rng.random((len(states), 1 if self.spec.discrete else self.spec.actions))
            chosen: Actions = self._policy.act(states, draws)
            return chosen.copy()

    def observe(self, obs: ArrayLike, action: ArrayLike, reward: ArrayLike, next_obs: ArrayLike, done: ArrayLike) -> None:
        """Record one transition per environment: ``obs`` and ``next_obs (B, S)``, ``action`` as from ``act``, others ``(B,)``.

        ``done``: whether the episode ended.  The arrays are copied.  Raises ValueError, and records nothing, for another
        shape or type, for nan, infinity and numbers beyond 1e12, for an action that the agent does not have, or if only
        some of the episodes ended: all environments of a batch have the same horizon.
        """
        with self._one_call, torch_threads(self.threads):
            spec, one, remedy = self.spec, (self._batch,), self._shape_remedy
            ended = arrays.flags("done", done, one, remedy)
            if ended.any() != ended.all():
                raise ValueError("done: the episodes of a batch must end together; use one agent per horizon")
            self._policy.observe(
                arrays.floats("obs", obs, (*one, spec.observation), remedy),
                arrays.choices("action", action, one, spec.actions, remedy)
                if spec.discrete
                else arrays.vectors("action", action, (*one, spec.actions), remedy),
                arrays.floats("reward", reward, one, remedy),
                arrays.floats("next_obs", next_obs, (*one, spec.observation), remedy),
                bool(ended.all()),
            )

    def distribution(self, states: ArrayLike, row: int = 0) -> Float[np.ndarray, "Q A"]:
        """T_theta(. | s, D) over discrete actions at states ``(Q, S)``, given the context of environment ``row``.

        The call does not change later actions.  Raises ValueError if actions are vectors, for a ``row`` that is none, and
        for states as ``act`` does.
        """
        if not self.spec.discrete:
            raise ValueError("distribution: the actions of this agent are vectors; use an agent with discrete actions")
        with self._one_call, torch_threads(self.threads):
            queries = arrays.floats("states", states, (None, self.spec.observation))
            found: np.ndarray = self._policy.distribution(queries, self._row(row))
            return found.copy()

    def context(self, row: int = 0) -> tuple[np.ndarray, ...]:
        """The context D of environment ``row``: observations (T, S), actions (T), next observations (T, S) and rewards (T).

        Raises ValueError for a ``row`` that is none.
        """
        with self._one_call:
            return tuple(column.copy() for column in self._policy.context(self._row(row)))

    def _row(self, row: int) -> int:
        return arrays.whole("row", row, 0, self._batch - 1)

    @property
    def _shape_remedy(self) -> str:
        kind = "numbers" if self.spec.discrete else "components"
        return (
            f"; reset_context(batch=B) sets B; this agent was trained with {self.spec.observation} observation components "
            f"and {self.spec.actions} action {kind}"
        )


def _check_decoder(decoder: object) -> None:
    if decoder not in get_args(Decoder):
        choices = get_args(Decoder)
        raise ConfigError(f"decoder = {decoder!r}{nearest(str(decoder), choices)}: choose one of {', '.join(choices)}")
    if decoder == "kernel" and isinstance(why := library("decoder"), Unusable):
        raise ConfigError(f"decoder = 'kernel': {why}; or leave decoder at 'auto'")
