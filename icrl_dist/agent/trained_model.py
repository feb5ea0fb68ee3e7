"""A trained model with the run that trained it."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, Self

import numpy as np

from icrl_dist.agent.threads import torch_threads
from icrl_dist.config.run import Run
from icrl_dist.config.sections import ContextConfig
from icrl_dist.interfaces import Method
from icrl_dist.models.kernel import decoder_here
from icrl_dist.types import Spec

if TYPE_CHECKING:
    import torch


class TrainedModel:
    """A model, and the run, method and spec that its deployment needs."""

    def __init__(self, run: Run, method: Method, spec: Spec, model: torch.nn.Module | None) -> None:
        """``model``: None only in ``stored``."""
        self.run, self.method, self.spec = run, method, spec
        self._model = model
        self._weights: Mapping[str, np.ndarray] = {}
        self._stored: Any = None

    @classmethod
    def stored(cls, run: Run, method: Method, spec: Spec, weights: Mapping[str, np.ndarray]) -> Self:
        """The model of a checkpoint with these weights; the torch model is built when it is needed.

        Raises ValueError, or what ``method.build`` raises, if the weights do not fit the method's model.
        """
        made = cls(run, method, spec, None)
        made._weights, made._stored = weights, method.stored_model(spec, run, weights)
        if made._stored is None:
            _ = made.model  # builds it, which checks the weights
        return made

    @property
    def model(self) -> torch.nn.Module:
        """The model in torch.  It is built, by one thread, at the first use; from then on ``to_deploy`` gives it."""
        if self._model is None:
            from icrl_dist.telemetry.processes import import_torch

            import_torch()
            import torch

            from icrl_dist.models.weights import load_weights

            # An untrained model takes random numbers of the process.
            with torch_threads(1), torch.random.fork_rng(()):
                model = self.method.build(self.spec, self.run)
                load_weights(model, self._weights)
            self._model = model.eval()
        return self._model

    def to_deploy(self, context: ContextConfig) -> Any:
        """What ``method.policy`` takes: the stored weights if the kernel decodes and nobody has used ``model``, else that."""
        decoder = decoder_here(context.decoder, self.run.model)
        untouched = self._model is None and self._stored is not None
        return self._stored if untouched and decoder == "kernel" else self.model
