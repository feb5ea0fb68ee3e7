"""Stored weights are held to their model without torch, with the names and shapes that torch gives them."""

from __future__ import annotations

import itertools

import numpy as np
import pytest

from icrl_dist.config.run import Run
from icrl_dist.config.sections import ModelConfig
from icrl_dist.methods import registry as methods
from icrl_dist.methods.dpt import DPT
from icrl_dist.models.dpt import PretrainedTransformer
from icrl_dist.models.stored import StoredTransformer, shapes
from icrl_dist.models.weights import load_weights, weights_of
from icrl_dist.types import Spec
from tests.models.networks import SPEC, build

CONFIGS = [
    ModelConfig(layers, heads, width, fourier, window=window)
    for layers, (heads, width), fourier, window in itertools.product((1, 3), ((1, 8), (2, 24)), (0, 2), (1, 4))
]
SPECS = (
    SPEC,
    Spec((0.0,), (1.0,), actions=1, horizon=4),
    Spec((-1.0,) * 7, (1.0,) * 7, actions=3, horizon=4, discrete=False),
)


@pytest.mark.parametrize("spec", SPECS, ids=("two components", "one", "vectors"))
def test_names_and_shapes_are_those_of_the_model_in_its_order(spec: Spec) -> None:
    for config in CONFIGS:
        model = PretrainedTransformer(spec, config)
        assert list(shapes(spec, config)) == [(name, tuple(value.shape)) for name, value in model.state_dict().items()]


WRONG = {
    "a shape": ("head.weight", np.zeros((5, 15), np.float32), r"head\.weight has shape \(5, 15\), not \(5, 16\)"),
    "a missing array": ("trunk.norm.bias", None, r"trunk\.norm\.bias is missing"),
    "an unknown array": ("head.height", np.zeros(3, np.float32), r"head\.height is unknown"),
}


@pytest.mark.parametrize("what", WRONG)
def test_weights_of_another_model_are_refused_in_the_same_words_with_and_without_torch(what: str) -> None:
    model, (name, value, message) = build(), WRONG[what]
    arrays = {**weights_of(model), name: value}
    given = {name: array for name, array in arrays.items() if array is not None}
    with pytest.raises(ValueError, match=message) as by_torch:
        load_weights(model, given)
    with pytest.raises(ValueError, match=message) as stored:
        StoredTransformer.of(model.spec, model.config, given)
    assert str(by_torch.value) == str(stored.value)


def test_other_numbers_and_a_model_without_end_are_refused() -> None:
    model = build()
    arrays = weights_of(model)
    assert StoredTransformer.of(model.spec, model.config, arrays).weights is arrays
    with pytest.raises(ValueError, match=r"head\.bias of type float64"):
        StoredTransformer.of(model.spec, model.config, {**arrays, "head.bias": arrays["head.bias"].astype(np.float64)})
    with pytest.raises(ValueError, match=r"blocks\.3\.norm_attention\.weight is missing.*blocks\.3\.out\.weight is missing$"):
        StoredTransformer.of(model.spec, ModelConfig(10**12, 2, 16), arrays)
    with pytest.raises(ValueError, match="inhomogeneous"):
        StoredTransformer.of(Spec((0.0, 0.0), (4.0,), 5, 8), model.config, arrays)


def test_a_method_that_changes_model_or_policy_keeps_the_model_in_torch(small_run: Run) -> None:
    class OtherModel(DPT):
        def build(self, spec, run):
            return super().build(spec, run)

    class OtherPolicy(DPT):
        def policy(self, *arguments):
            return super().policy(*arguments)

    weights = weights_of(PretrainedTransformer(SPEC, small_run.model))
    assert isinstance(methods.of(small_run).stored_model(SPEC, small_run, weights), StoredTransformer)
    assert OtherModel().stored_model(SPEC, small_run, weights) is None
    assert OtherPolicy().stored_model(SPEC, small_run, weights) is None
