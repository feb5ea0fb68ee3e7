"""The decision transformer: what each output depends on, and its decisions in deployment."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from icrl_dist.config.sections import ModelConfig, OptimConfig
from icrl_dist.models.dt import DecisionTransformer
from icrl_dist.models.segments import PromptBatch, Segments
from icrl_dist.models.weights import load_weights, weights_of
from icrl_dist.training import fit
from icrl_dist.types import Spec

DISCRETE = Spec((0.0, 0.0), (4.0, 4.0), actions=3, horizon=9)
VECTORS = Spec((-1.0, -1.0), (1.0, 1.0), actions=2, horizon=9, discrete=False)
B, L, P = 3, 5, 2


def model(spec: Spec = DISCRETE) -> DecisionTransformer:
    torch.manual_seed(0)
    return DecisionTransformer(spec, ModelConfig(layers=2, heads=2, width=16), L, P).eval()


def segments(spec: Spec, length: int, seed: int = 0, batch: int = B) -> Segments:
    rng = np.random.default_rng(seed)
    shape = (batch, length)
    actions = rng.integers(0, 3, shape) if spec.discrete else rng.uniform(-1, 1, (*shape, 2)).astype(np.float32)
    states = rng.uniform(spec.low, spec.high, (*shape, 2)).astype(np.float32)
    steps = np.tile(np.arange(length), (batch, 1))
    return Segments(rng.normal(size=shape).astype(np.float32), states, actions, steps, np.ones(shape, bool))


def outputs(one: DecisionTransformer, prompt: Segments, window: Segments) -> np.ndarray:
    with torch.no_grad():
        found: np.ndarray = one(one.encode(prompt), window).numpy()
        return found


def changed(column: np.ndarray, *place: slice | int) -> np.ndarray:
    """The column with other values at this place."""
    found = column.copy()
    found[place] = (found[place] + 1) % 3
    return found


@pytest.mark.parametrize("spec", [DISCRETE, VECTORS])
def test_an_output_depends_on_prompt_and_past_and_neither_on_its_own_action_nor_on_later_steps(spec: Spec) -> None:
    one, prompt, window = model(spec), segments(spec, P, 1), segments(spec, L)
    before = outputs(one, prompt, window)
    for h in range(L):
        for name in ("to_go", "observations", "actions"):
            after = outputs(one, prompt, window._replace(**{name: changed(getattr(window, name), slice(None), h)}))
            moved = abs(after - before).max(axis=(0, 2)) > 1e-5
            assert moved.tolist() == [k > h or (k == h and name != "actions") for k in range(L)], (h, name)
    for name in ("to_go", "observations", "actions"):
        after = outputs(one, prompt._replace(**{name: changed(getattr(prompt, name), slice(None), 0)}), window)
        assert (abs(after - before).max(axis=(1, 2)) > 1e-5).all(), name
    later = outputs(one, prompt, window._replace(steps=window.steps + 1))
    assert abs(later - before).max() > 1e-3, "the number of a step is an input"


def test_a_prompt_that_is_not_valid_is_no_input() -> None:
    one, prompt, window = model(), segments(DISCRETE, P, 1), segments(DISCRETE, L)
    valid = np.array([[True, True], [True, False], [False, False]])
    before = outputs(one, prompt._replace(valid=valid), window)
    other = segments(DISCRETE, P, 2)
    shown = (valid[..., None], valid)
    mixed = Segments(
        np.where(shown[1], prompt.to_go, other.to_go),
        np.where(shown[0], prompt.observations, other.observations),
        np.where(shown[1], prompt.actions, other.actions),
        prompt.steps,
        valid,
    )
    np.testing.assert_allclose(outputs(one, mixed, window), before, atol=1e-6)
    assert abs(outputs(one, other._replace(valid=valid), window)[2] - before[2]).max() < 1e-6
    assert abs(outputs(one, prompt, window)[1:] - before[1:]).max() > 1e-3


@pytest.mark.parametrize("spec", [DISCRETE, VECTORS])
def test_the_loss_takes_every_valid_step_and_no_padding(spec: Spec) -> None:
    one, prompt, window = model(spec), segments(spec, P, 1), segments(spec, L)
    window.actions[:, 0] = 0  # a true action 0 (or zero vector), which is no padding
    lengths = (5, 2, 1)
    valid = np.arange(L) < np.array(lengths)[:, None]
    with torch.no_grad():
        found = one.loss(PromptBatch(prompt, window._replace(valid=valid), 1.0, 1.0)).item()
    raw, losses = outputs(one, prompt, window), []
    for row, length in enumerate(lengths):
        for h in range(length):
            if spec.discrete:
                scores = np.exp(raw[row, h].astype(np.float64))
                losses.append(-np.log(scores[window.actions[row, h]] / scores.sum()))
            else:
                losses += list((np.tanh(raw[row, h]) - window.actions[row, h]) ** 2)
    assert found == pytest.approx(np.mean(losses), rel=1e-5)


def test_decisions_step_by_step_equal_those_of_the_whole_window() -> None:
    one, prompt, window = model(), segments(DISCRETE, P, 1), segments(DISCRETE, L)
    whole, past = outputs(one, prompt, window), one.encode_frozen(prompt)
    for h in range(L):
        step = Segments(*(column[:, max(0, h - 1) : h + 1] for column in window))  # the step before is complete now
        found, past = one.decide(past, step)
        np.testing.assert_allclose(found, whole[:, h], atol=1e-5)
        assert past.cache[0][0].shape[2] == past.visible.shape[1] == 3 * (P + h)


def test_target_and_scale_are_stored_with_the_weights() -> None:
    one, other = model(), model()
    one.loss(PromptBatch(segments(DISCRETE, P), segments(DISCRETE, L), 12.0, 15.0))
    assert weights_of(one)["target"] == 12 and weights_of(one)["scale"] == 15
    load_weights(other, weights_of(one))
    window = segments(DISCRETE, L)
    np.testing.assert_array_equal(outputs(other, segments(DISCRETE, P), window), outputs(one, segments(DISCRETE, P), window))
    half = window._replace(to_go=window.to_go / 15)
    assert abs(outputs(model(), segments(DISCRETE, P)._replace(to_go=segments(DISCRETE, P).to_go / 15), half)).max() > 0
    np.testing.assert_allclose(
        outputs(model(), segments(DISCRETE, P)._replace(to_go=segments(DISCRETE, P).to_go / 15), half),
        outputs(one, segments(DISCRETE, P), window),
        atol=1e-5,
    )


@pytest.mark.parametrize("spec", [DISCRETE, VECTORS])
def test_a_fit_learns_actions_that_follow_the_return_to_go(spec: Spec) -> None:
    """Whoever asks for much acts one way, whoever asks for little the other."""
    one, optim = model(spec), OptimConfig(learning_rate=3e-3, warmup=5)

    def batch(step: int) -> PromptBatch:
        window = segments(spec, L, step, batch=16)
        much = window.to_go > 0
        actions = np.where(much, 2, 0) if spec.discrete else np.where(much, 0.5, -0.5)[..., None].repeat(2, -1)
        return PromptBatch(segments(spec, P, step, 16), window._replace(actions=actions.astype(window.actions.dtype)), 1.0, 1.0)

    fit.fit(one, fit.Optimizer(one, optim), optim, optim.learning_rate, 250, lambda step: one.loss(batch(step)))
    prompt, window = segments(spec, P, 900), segments(spec, L, 901)
    for value, action in ((1.0, 2), (-1.0, 0)):
        steps = window._replace(to_go=np.full_like(window.to_go, value))
        found = one.act(one.decide(one.encode_frozen(prompt), steps)[0], np.full((B, 1), 0.5))
        if spec.discrete:
            assert found.tolist() == [action] * B
        else:
            assert found == pytest.approx(np.full((B, 2), value / 2), abs=0.3) and found.dtype == np.float32
