"""The deployed transformer by the compiled decoder: ``models.dpt.DeployedTransformer`` on numpy, without torch."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from jaxtyping import Float, Float32

from icrl_dist.config.sections import ModelConfig
from icrl_dist.copies import CopiedWhole
from icrl_dist.interfaces import Actions
from icrl_dist.models.deployed import Columns, WindowColumns
from icrl_dist.models.features import Features
from icrl_dist.models.kernel import Kernel, padded
from icrl_dist.models.kernel_decoder import KernelDecoder
from icrl_dist.models.sampling import FLOOR, sample, sample_gaussian
from icrl_dist.models.stored import check_shapes, shapes
from icrl_dist.types import Spec


class KernelTransformer(CopiedWhole):
    """``models.deployed.Deployed`` by the kernel.

    Every sum over inputs, tokens or actions runs in the kernel and in its order, so the outputs are equal bit by bit
    on all processors, and so are discrete actions.
    """

    def __init__(
        self, spec: Spec, config: ModelConfig, weights: Mapping[str, np.ndarray], batch: int, kernel: Kernel | None = None
    ) -> None:
        """``weights``: by their names in a checkpoint, without ``model/``.

        Raises ValueError for weights of another model, or for ``batch`` below 1.
        """
        check_shapes(shapes(spec, config), weights)
        self._spec, self._kernel = spec, kernel or Kernel()
        trunk = {name.removeprefix("trunk."): value for name, value in weights.items() if name.startswith("trunk.")}
        self._decoder = KernelDecoder(trunk, config.heads, batch, self._kernel)
        self._features = Features(spec, config.fourier)
        self._linear = {
            name: (padded(weights[f"{name}.weight"].T), padded(weights[f"{name}.bias"]), len(weights[f"{name}.bias"]))
            for name in ("embed_transition", "embed_query", "embed_taken", "head")
            if f"{name}.weight" in weights
        }
        self.state: Float32[np.ndarray, "B D"] | None = None

    @property
    def length(self) -> int:
        return self._decoder.length

    def clear(self) -> None:
        self._decoder.clear()

    def append(self, transitions: Columns) -> None:
        self._decoder.append(self._tokens(transitions))

    def decide(self, states: Float32[np.ndarray, "B S"]) -> Float32[np.ndarray, "B O"]:
        return self._outputs(self._decoder.query(self._layer("embed_query", self._features.observations(states))))

    def decide_window(self, windows: WindowColumns, arrived: Columns | None = None) -> Float32[np.ndarray, "B O"]:
        token = None if arrived is None else self._tokens(arrived)[:, 0]
        states = self._features.observations(windows.states)
        # Each state, plus the previous state of the window with its action and reward; the first has no previous one.
        taken = [states[:, :-1], self._features.actions(windows.prev_actions)[:, :-1], windows.prev_rewards[:, :-1, None]]
        tokens = self._layer("embed_query", states)
        tokens[:, 1:] += self._layer("embed_taken", np.concatenate(taken, axis=-1, dtype=np.float32))
        return self._outputs(self._decoder.window(tokens, token))

    def decide_row(self, row: int, states: Float32[np.ndarray, "Q S"], appended: Columns) -> Float32[np.ndarray, "Q O"]:
        queries = self._layer("embed_query", self._features.observations(states))
        return self._layer("head", self._decoder.query_row(row, queries, self._tokens(appended)[0]))

    def act(self, outputs: Float32[np.ndarray, "B O"], u: Float[np.ndarray, "B U"]) -> Actions:
        if self._spec.discrete:
            return sample(self.probabilities(outputs), u[:, 0])
        mean, raw = np.split(outputs, 2, axis=-1)
        with np.errstate(invalid="ignore"):  # as torch: nan without a warning
            deviation = FLOOR + np.logaddexp(np.float32(0), raw)
        return sample_gaussian(mean, deviation, u)

    def probabilities(self, outputs: Float32[np.ndarray, "B O"]) -> Float32[np.ndarray, "B A"]:
        return self._kernel.softmax(padded(outputs), outputs.shape[1])

    def _outputs(self, state: Float32[np.ndarray, "B D"]) -> Float32[np.ndarray, "B O"]:
        self.state = state
        return self._layer("head", state)

    def _layer(self, name: str, x: Float32[np.ndarray, "*B I"]) -> Float32[np.ndarray, "*B O"]:
        weight, bias, outputs = self._linear[name]
        flat = self._kernel.linear(x.reshape(-1, x.shape[-1]), weight, bias)
        return flat.reshape(*x.shape[:-1], flat.shape[1])[..., :outputs]

    def _tokens(self, transitions: Columns) -> Float32[np.ndarray, "B T D"]:
        return self._layer("embed_transition", self._features.transitions(*transitions))
