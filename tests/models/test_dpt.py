"""T_theta: what each query sees, its inputs, and its weights as arrays."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch

from icrl_dist.config.sections import ModelConfig
from icrl_dist.models.dpt import PretrainedTransformer, Transitions
from icrl_dist.models.weights import load_weights, weights_of
from tests.models.networks import SPEC, B, Q, T, build, changed, part, states, transitions


@torch.no_grad()
def test_a_prefix_equals_a_shorter_context() -> None:
    model, whole, queries = build(), transitions(), states(T + 1)
    together = model(whole, queries, torch.arange(T + 1).repeat(B, 1))
    for n in range(T + 1):
        single = model.decide(queries[:, n : n + 1], model.encode(part(whole, 0, n)))
        torch.testing.assert_close(together[:, n : n + 1], single, atol=1e-5, rtol=1e-5)


@torch.no_grad()
@pytest.mark.parametrize("at", [0, 6, 7, 19])
def test_a_query_sees_its_prefix_and_no_later_transition(at: int) -> None:
    model, queries = build(), states(T + 1)
    prefix = torch.arange(T + 1).repeat(B, 1)
    before, after = (model(c, queries, prefix) for c in (transitions(), changed(transitions(), at)))
    difference = (before - after).abs().amax(dim=(0, 2))
    assert (difference[: at + 1] < 1e-6).all(), "a prediction depends on a transition after its prefix"
    assert (difference[at + 1 :] > 1e-4).all(), "a prediction does not depend on a transition of its prefix"


@torch.no_grad()
@pytest.mark.parametrize("column", Transitions._fields)
def test_every_column_of_a_transition_changes_outputs(column: str) -> None:
    model, context, queries = build(), transitions(), states()
    other = context._replace(**{column: getattr(changed(context, 5), column)})
    logits = [model.decide(queries, model.encode(c)) for c in (context, other)]
    assert (logits[0] - logits[1]).abs().amax() > 1e-4


@torch.no_grad()
def test_queries_do_not_see_one_another() -> None:
    model, context, queries = build(), transitions(), states()
    prefix = torch.randint(0, T + 1, (B, Q), generator=torch.Generator().manual_seed(1))
    together = model(context, queries, prefix)
    for n in range(Q):
        single = model(context, queries[:, n : n + 1], prefix[:, n : n + 1])
        torch.testing.assert_close(together[:, n : n + 1], single, atol=1e-6, rtol=1e-5)
    assert together.std(dim=1).min() > 1e-3, "outputs hardly depend on the query: the comparison would prove nothing"


@torch.no_grad()
def test_padding_at_the_end_changes_nothing() -> None:
    model, context, queries = build(), transitions(), states()
    prefix = torch.randint(0, T + 1, (B, Q), generator=torch.Generator().manual_seed(1))
    padded = Transitions(*(torch.cat([c, torch.zeros_like(c[:, :9])], dim=1) for c in context))
    torch.testing.assert_close(model(padded, queries, prefix), model(context, queries, prefix), atol=1e-6, rtol=1e-5)


@torch.no_grad()
def test_rows_of_a_batch_are_independent() -> None:
    model, queries = build(), states()
    logits = model.decide(queries, model.encode(transitions()))
    one = Transitions(*(c[1:2] for c in transitions()))
    torch.testing.assert_close(model.decide(queries[1:2], model.encode(one)), logits[1:2], atol=1e-6, rtol=1e-5)


@torch.no_grad()
def test_with_an_empty_context_outputs_depend_on_the_query_alone() -> None:
    model = build()
    logits = model.decide(states(), model.encode(transitions(0)))
    assert torch.isfinite(logits).all()
    torch.testing.assert_close(
        logits, model(transitions(), states(), torch.zeros(B, Q, dtype=torch.int64)), atol=1e-6, rtol=1e-5
    )


@torch.no_grad()
def test_observations_are_scaled_and_have_fourier_features() -> None:
    corners = torch.tensor([[0.0, 0.0], [4.0, 4.0], [2.0, 1.0]])
    torch.testing.assert_close(build().features(corners), torch.tensor([[-1.0, -1.0], [1.0, 1.0], [0.0, -0.5]]))
    waves = build(fourier=2).features(corners)[2]
    slow = [0.0, -0.5]
    for k in (1, 2):
        slow += [math.sin(math.pi / 2 * k * x) for x in (0.0, -0.5)] + [math.cos(math.pi / 2 * k * x) for x in (0.0, -0.5)]
    assert waves.tolist() == pytest.approx(slow, abs=1e-6)


def test_weights_round_trip_and_are_copies() -> None:
    model, other = build(), PretrainedTransformer(SPEC, ModelConfig(3, 2, 16))
    arrays = weights_of(model)
    assert all(a.dtype == np.dtype("<f4") for a in arrays.values())
    frozen = {name: np.frombuffer(a.tobytes(), a.dtype).reshape(a.shape) for name, a in arrays.items()}
    load_weights(other, frozen)
    with torch.no_grad():
        args = (transitions(), states(), torch.full((B, Q), T))
        before = model(*args)
        torch.testing.assert_close(other.eval()(*args), before, atol=0, rtol=0)
        for a in arrays.values():
            a[...] = 0
        torch.testing.assert_close(model(*args), before, atol=0, rtol=0)
        for parameter in other.parameters():
            parameter.zero_()
    assert all(a.any() for a in frozen.values()), "a write to the loaded model changed the arrays"


@pytest.mark.parametrize("wrong", ["shape", "missing", "unknown"])
def test_weights_that_do_not_fit_are_refused_by_name(wrong: str) -> None:
    model = build()
    arrays = weights_of(model)
    if wrong == "shape":
        arrays["head.weight"] = arrays["head.weight"][:, :-1]
    elif wrong == "missing":
        del arrays["head.weight"]
    else:
        arrays["head.height"] = np.zeros(3, np.float32)
    with pytest.raises(ValueError, match=r"head\.height" if wrong == "unknown" else r"head\.weight"):
        load_weights(model, arrays)
