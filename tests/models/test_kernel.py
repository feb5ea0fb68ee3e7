"""The compiled decoder against torch, against itself on other instruction sets, and against wrong use."""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import torch

from icrl_dist.agent.loading import SHIPPED, open_checkpoint, shipped, trained
from icrl_dist.config.sections import ModelConfig
from icrl_dist.models.compiled import kinds
from icrl_dist.models.deployed import Columns, Deployed
from icrl_dist.models.dpt import DeployedTransformer, PretrainedTransformer
from icrl_dist.models.kernel_transformer import KernelTransformer
from icrl_dist.models.weights import weights_of
from icrl_dist.types import Spec
from tests.models.deployments import deployment
from tests.models.random_networks import Case, case, columns, network, operations, window

pytestmark = pytest.mark.skipif(not kinds(), reason="the decoder was not compiled, or not for this processor")

SPEC = Spec((0.0, 0.0), (4.0, 4.0), 5, 8)
HERE = kinds()[-1] if kinds() else ""


def deployed(of: Case, kind: str = HERE) -> Deployed:
    return deployment(kind)(of.model, of.batch)


def small(batch: int = 3, scale: float = 0.3, **config: Any) -> Case:
    return Case(SPEC, network(SPEC, ModelConfig(**{"layers": 2, "heads": 2, "width": 20, **config}), 0, scale), batch)


def close(found: np.ndarray, expected: np.ndarray, tolerance: float = 1e-5) -> None:
    """Equal in relation to the largest output."""
    np.testing.assert_allclose(found, expected, rtol=0, atol=tolerance * float(np.abs(expected).max()))


@pytest.mark.parametrize("seed", range(12))
def test_random_networks_decide_as_with_torch_and_with_equal_bits_on_every_instruction_set(seed: int) -> None:
    rng = np.random.default_rng(seed)
    of, compared = case(rng), 0
    for expected, *found in operations(rng, of, [DeployedTransformer(of.model, of.batch), *map_kinds(of)], 16):
        close(found[0], expected)
        assert len({one.tobytes() for one in found}) == 1
        compared += 1
    assert compared > 3


def map_kinds(of: Case) -> list[Deployed]:
    return [deployed(of, kind) for kind in kinds()]


@pytest.mark.parametrize("length", [0, 1, 127, 128, 129, 400])
@pytest.mark.parametrize("batch", [1, 513])
def test_contexts_at_the_borders_of_chunks(length: int, batch: int) -> None:
    of, rng = small(batch, width=6), np.random.default_rng(length)
    context, states = columns(rng, SPEC, batch, length), columns(rng, SPEC, batch, 1).observations[:, 0]
    outputs = []
    for one in (DeployedTransformer(of.model, batch), deployed(of)):
        one.append(context)
        outputs.append(one.decide(states))
    close(outputs[1], outputs[0])


@pytest.mark.parametrize("name", SHIPPED)
def test_shipped_agents_decide_as_with_torch(name: str) -> None:
    of, rng = trained(open_checkpoint(shipped(name))), np.random.default_rng(0)
    assert isinstance(of.model, PretrainedTransformer)
    one = Case(of.spec, of.model, 20)
    results = list(operations(rng, one, [DeployedTransformer(one.model, 20), deployed(one)], 20))
    for expected, found in results:
        close(found, expected)
    assert len(results) > 5


@pytest.mark.parametrize("seed", range(6))
def test_a_context_alone_or_appended_in_pieces_gives_the_same_bits(seed: int) -> None:
    """Rows pass through the layers 16 at a time, and queries 4 at a time: neither grouping may show."""
    rng = np.random.default_rng(seed)
    of = case(rng, batch=20)
    context, states = columns(rng, of.spec, 20, 150), columns(rng, of.spec, 20, 1).observations[:, 0]
    together = deployed(of)
    together.append(context)
    outputs = together.decide(states)
    for row in (0, 7, 19):
        alone = deployed(Case(of.spec, of.model, 1))
        for start, stop in ((0, 1), (1, 6), (6, 130), (130, 150)):
            alone.append(Columns(*(column[row : row + 1, start:stop] for column in context)))
        assert alone.decide(states[row : row + 1]).tobytes() == outputs[row : row + 1].tobytes()
        nothing = Columns(*(column[:1, :0] for column in context))
        assert together.decide_row(row, states[row : row + 1], nothing).tobytes() == outputs[row : row + 1].tobytes()


def test_scores_in_the_hundreds_do_not_overflow() -> None:
    """Weights of three times the usual size: a query's scores of its context lie between -2,000 and 2,000."""
    of, rng = small(scale=1.5), np.random.default_rng(0)
    context, states = columns(rng, SPEC, 3, 200), columns(rng, SPEC, 3, 1).observations[:, 0]
    outputs = []
    for one in (DeployedTransformer(of.model, 3), deployed(of)):
        one.append(context)
        outputs.append(one.decide(states))
    assert np.isfinite(outputs[1]).all()
    close(outputs[1], outputs[0], 1e-4)


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
@pytest.mark.parametrize("heads", [1, 4])
def test_numbers_that_are_not_finite_make_their_own_context_nan_until_it_is_cleared(value: float, heads: int) -> None:
    of, rng = small(heads=heads, window=4), np.random.default_rng(1)
    good, later = columns(rng, SPEC, 3, 40), columns(rng, SPEC, 3, 5)
    bad = Columns(*(column.copy() for column in good))
    bad.observations[1, 30] = value
    for make in (lambda: DeployedTransformer(of.model, 3), lambda: deployed(of)):
        one, other = make(), make()
        one.append(bad)
        other.append(good)
        states = later.observations[:, 0]
        found, expected = one.decide(states), other.decide(states)
        assert np.isnan(found[1]).all() and (found[[0, 2]] == expected[[0, 2]]).all()
        assert np.isnan(one.probabilities(found)[1]).all()
        for two in (one, other):
            two.clear()
            two.append(later)
        assert (one.decide(states) == other.decide(states)).all(), "a nan of before `clear` is still read"


@pytest.mark.parametrize("value", [np.nan, np.inf, 1e30])
@pytest.mark.parametrize("discrete", [False, True])
def test_actions_of_observations_that_are_not_finite_are_those_of_torch(value: float, discrete: bool) -> None:
    spec, rng = Spec((0.0, 0.0), (4.0, 4.0), 3, 8, discrete), np.random.default_rng(9)
    model = network(spec, ModelConfig(2, 2, 20, fourier=1), 0, 0.3)
    states, u = columns(rng, spec, 3, 1).observations[:, 0], rng.random((3, 1 if discrete else 3))
    states[1] = value
    outputs = []
    for one in (DeployedTransformer(model, 3), deployed(Case(spec, model, 3))):
        outputs.append(one.act(one.decide(states), u))
    np.testing.assert_allclose(outputs[1], outputs[0], atol=1e-5)


@pytest.mark.parametrize("heads", [1, 4])
@pytest.mark.parametrize("how", ["decide", "window", "row"])
def test_a_query_that_is_not_finite_leaves_nothing_behind(how: str, heads: int) -> None:
    of, rng = small(heads=heads, window=4), np.random.default_rng(2)
    context, seen = columns(rng, SPEC, 3, 20), columns(rng, SPEC, 3, 4)
    one, states = deployed(of), seen.observations[:, 0]
    one.append(context)
    before = one.decide(states)
    bad = Columns(*(column.copy() for column in seen))
    bad.observations[:] = np.nan
    if how == "decide":
        found = one.decide(bad.observations[:, 0])
    elif how == "window":
        found = one.decide_window(window(bad))
    else:
        found = one.decide_row(1, states, Columns(*(column[:1] for column in bad)))
    assert np.isnan(found).all()
    assert (one.decide(states) == before).all()
    one.append(Columns(*(column[:, :1] for column in context)))
    assert np.isfinite(one.decide(states)).all()


def test_arrays_of_another_layout_give_the_same_bits() -> None:
    of, rng = small(), np.random.default_rng(3)
    context, states = columns(rng, SPEC, 3, 30), columns(rng, SPEC, 3, 1).observations[:, 0]
    outputs = []
    for change in (np.asarray, np.asfortranarray, lambda x: np.repeat(x, 2, axis=1)[:, ::2]):
        one = deployed(of)
        one.append(Columns(*(change(column) for column in context)))
        outputs.append(one.decide(change(states)).tobytes())
    assert len(set(outputs)) == 1


def with_action(action: int) -> Columns:
    found = columns(np.random.default_rng(0), SPEC, 3, 5)
    found.actions[1, 2] = action
    return found


@pytest.mark.parametrize(
    "call",
    [
        lambda one: one.decide(np.zeros((2, 2), np.float32)),
        lambda one: one.decide(np.zeros((3, 3), np.float32)),
        lambda one: one.append(columns(np.random.default_rng(0), SPEC, 4, 5)),
        lambda one: one.append(columns(np.random.default_rng(0), SPEC, 1, 5)),
        lambda one: one.decide_window(window(columns(np.random.default_rng(0), SPEC, 2, 3))),
        lambda one: one.append(with_action(-1)),
        lambda one: one.append(with_action(5)),
        lambda one: one.decide_row(3, np.zeros((1, 2), np.float32), columns(np.random.default_rng(0), SPEC, 1, 0)),
        lambda one: one.decide_row(-1, np.zeros((1, 2), np.float32), columns(np.random.default_rng(0), SPEC, 1, 0)),
        lambda one: one.decide_row(0, np.zeros((1, 5), np.float32), columns(np.random.default_rng(0), SPEC, 1, 0)),
    ],
)
def test_arrays_of_wrong_shapes_are_refused_and_change_nothing(call: Callable[[Deployed], object]) -> None:
    of, rng = small(window=4), np.random.default_rng(4)
    one, states = deployed(of), columns(rng, SPEC, 3, 1).observations[:, 0]
    one.append(columns(rng, SPEC, 3, 20))
    before = one.decide(states)
    with pytest.raises(ValueError) as refused:
        call(one)
    assert "\n" not in str(refused.value)
    assert one.length == 20 and (one.decide(states) == before).all()


@pytest.mark.parametrize(
    ("name", "shape"), [("trunk.blocks.1.feed.0.weight", (79, 20)), ("head.bias", (4,)), ("trunk.norm.bias", None)]
)
def test_weights_of_wrong_shapes_are_refused(name: str, shape: tuple[int, ...] | None) -> None:
    of = small()
    weights = weights_of(of.model)
    KernelTransformer(SPEC, of.model.config, weights, 3)
    del weights[name]
    if shape is not None:
        weights[name] = np.zeros(shape, np.float32)
    with pytest.raises(ValueError, match=name.replace(".", r"\.")):
        KernelTransformer(SPEC, of.model.config, weights, 3)
    with pytest.raises(ValueError, match="expected at least 1"):
        KernelTransformer(SPEC, of.model.config, weights_of(of.model), 0)


@pytest.mark.parametrize("kind", kinds())
def test_outputs_are_those_of_every_other_processor(kind: str) -> None:
    """The digest was recorded with AVX2; a change of the order of sums changes it, and so digests of runs."""
    rng, batch = np.random.default_rng(0), 5
    model = network(SPEC, ModelConfig(3, 2, 40, window=4), 0, 0.3)
    with torch.no_grad():
        for parameter in model.parameters():  # numpy's integers are equal everywhere
            parameter.copy_(torch.from_numpy(rng.integers(-1000, 1000, tuple(parameter.shape)) / np.float32(2000)))
    one, found = deployed(Case(SPEC, model, batch), kind), hashlib.sha256()
    for length in (1, 130, 20):
        cells = rng.integers(0, 5, (2, batch, length, 2)).astype(np.float32)
        one.append(
            Columns(
                cells[0], rng.integers(0, 5, (batch, length)), cells[1], rng.integers(0, 2, (batch, length)) / np.float32(1)
            )
        )
        outputs = one.decide(cells[0, :, 0])
        found.update(outputs.tobytes() + one.probabilities(outputs).tobytes())
    cells = rng.integers(0, 5, (2, batch, 4, 2)).astype(np.float32)
    seen = Columns(cells[0], rng.integers(0, 5, (batch, 4)), cells[1], np.ones((batch, 4), np.float32))
    found.update(one.decide_window(window(seen), Columns(*(column[:, :1] for column in seen))).tobytes())
    assert found.hexdigest()[:16] == "dc147407f14c8ed0"
