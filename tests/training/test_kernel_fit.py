"""The fit through the compiled kernel: torch's loss, gradients and optimizers, the same on all processors and threads."""

from __future__ import annotations

import hashlib
import math
import threading
import time
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
import torch

from icrl_dist.config.sections import OptimConfig
from icrl_dist.models.compiled import kinds
from icrl_dist.models.features import sine_and_cosine
from icrl_dist.models.training_kernel import Contexts
from icrl_dist.models.weights import weights_of
from icrl_dist.training.fit import Optimizer, take_steps
from icrl_dist.training.kernel_fit import KernelFit, _power, cosine
from tests.training.kernel_fits import Case, by_torch

pytestmark = [
    pytest.mark.unit,
    pytest.mark.skipif(not kinds("training"), reason="the training kernel was not built"),
]

CASES = [
    Case(),
    Case(contexts=1, tokens=1, queries=2),
    Case(contexts=1, queries=1, tokens=4),
    Case(layers=1),
    Case(layers=4, tokens=50, queries=40),
    Case(heads=2),
    Case(heads=3, width=24, queries=17),
    Case(heads=4, width=12, tokens=33),
    Case(width=40, heads=4),
    Case(width=64, heads=2, contexts=18, tokens=9),
    Case(fourier=2),
    Case(windows=3, window=4),
    Case(windows=2, window=17, heads=2, fourier=1, layers=3),
    Case(discrete=False, actions=2),
    Case(discrete=False, actions=17, windows=2, window=3),
    Case(actions=18, width=20),
    Case(width=6, heads=2, actions=1, discrete=False),
]


@pytest.mark.parametrize("case", CASES, ids=lambda case: "-".join(map(str, case)))
def test_loss_and_gradients_are_those_of_torch(case: Case) -> None:
    model = case.model()
    batch = case.batch()
    loss, gradients = by_torch(model, batch)
    own_loss, own = case.fit(model).gradient(batch)
    assert own_loss == pytest.approx(loss, rel=1e-5)
    assert set(own) == set(gradients)
    for name, gradient in gradients.items():
        np.testing.assert_allclose(
            own[name], gradient.numpy(), rtol=0, atol=1e-4 * float(gradient.abs().max()) + 1e-8, err_msg=name
        )


@pytest.mark.parametrize("case", CASES, ids=lambda case: "-".join(map(str, case)))
def test_neither_threads_nor_instruction_sets_change_a_gradient(case: Case) -> None:
    model = case.model()
    batch = case.batch()
    loss, gradients = case.fit(model).gradient(batch)
    fits = [case.fit(model, threads=threads) for threads in (2, 3)] + [case.fit(model, kind=kind) for kind in kinds("training")]
    for fit in fits:
        own_loss, own = fit.gradient(batch)
        assert own_loss == loss
        for name, gradient in gradients.items():
            np.testing.assert_array_equal(own[name], gradient, err_msg=name)


@pytest.mark.parametrize(("muon", "in_float32"), [(0.0, False), (5.0, True), (5.0, False)])
def test_steps_are_those_of_torchs_optimizers(muon: float, in_float32: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    """Given the same gradients, to rounding; torch computes Muon in bfloat16, with which its steps differ by a fifth."""
    if in_float32:
        monkeypatch.setattr(torch.Tensor, "bfloat16", torch.Tensor.float)
    case = Case(heads=2, width=24, windows=2, window=3)
    settings = OptimConfig(muon=muon, weight_decay=0.1, beta2=0.98, clip=0.2)
    model = case.model()
    optimizer = Optimizer(model, settings)
    state: dict[str, np.ndarray] = {}
    for seed in range(3):
        before, batch = weights_of(model), case.batch(seed)
        fit = fresh(case, settings, weights_of(model), state)
        _, gradients = fit.gradient(batch)
        for name, parameter in model.named_parameters():
            parameter.grad = torch.from_numpy(gradients[name].copy())
        torch.nn.utils.clip_grad_norm_(model.parameters(), settings.clip)
        optimizer.step(1e-3)
        fit.step(batch, 1e-3)
        for name, weight in weights_of(model).items():
            change, own = weight - before[name], fit.weights[name] - before[name]
            rough = muon and not in_float32 and name.startswith("trunk.") and weight.ndim == 2
            assert np.linalg.norm(own - change) <= (0.3 if rough else 1e-4) * np.linalg.norm(change), name
        state = optimizer.state()


def fresh(case: Case, settings: OptimConfig, weights: dict[str, np.ndarray], state: dict[str, np.ndarray]) -> KernelFit:
    """A fit that continues from a checkpoint."""
    fit = KernelFit(case.spec, case.config, settings, weights)
    fit.load(state)
    return fit


@pytest.mark.parametrize("muon", [0.0, 5.0])
def test_a_fit_continues_from_its_state_as_if_it_had_not_stopped(muon: float) -> None:
    case, settings = Case(), OptimConfig(muon=muon)
    first = case.fit(case.model(), muon=muon)
    batches = [case.batch(seed) for seed in range(4)]
    assert first.state() == {}
    for batch in batches[:2]:
        first.step(batch, 1e-3)
    second = fresh(case, settings, {name: weight.copy() for name, weight in first.weights.items()}, first.state())
    for batch in batches[2:]:
        assert first.step(batch, 1e-3) == second.step(batch, 1e-3)
    for name, weight in first.weights.items():
        np.testing.assert_array_equal(second.weights[name], weight)
    for name, value in first.state().items():
        np.testing.assert_array_equal(second.state()[name], value)
    torch_state = Optimizer(case.model(), settings)
    torch_state.load(first.state())
    assert set(torch_state.state()) == set(first.state()), "torch's optimizer has the same state"


def test_the_state_of_another_optimizer_is_refused() -> None:
    case = Case()
    fit = case.fit(case.model())
    fit.step(case.batch(), 1e-3)
    count = len(fit.weights)
    with pytest.raises(ValueError, match=f"AdamW and Muon train {count} and 0 parameters there, {count - 8} and 8 here"):
        case.fit(case.model(), muon=1.0).load(fit.state())


def lacks(state: dict[str, np.ndarray]) -> None:
    del state["0/1/exp_avg_sq"]


def broadcast(state: dict[str, np.ndarray]) -> None:
    state["0/1/exp_avg"] = np.array(1, np.float32)


def texts(state: dict[str, np.ndarray]) -> None:
    state["0/1/exp_avg"] = state["0/1/exp_avg"].astype("U8")


def unknown(state: dict[str, np.ndarray]) -> None:
    state["0/1/max_exp_avg_sq"] = state["0/1/exp_avg_sq"]


def taking(count: float) -> Callable[[dict[str, np.ndarray]], None]:
    return lambda state: state.update({name: np.array(count, np.float32) for name in state if name.endswith("/step")})


DAMAGE = {
    "it lacks 0/1/exp_avg_sq": lacks,
    r"0/1/exp_avg has the shape \(\)": broadcast,
    "0/1/exp_avg has .* the type <U8": texts,
    "0/1/max_exp_avg_sq, which is unknown": unknown,
    "took -3 steps": taking(-3),
    "took 2.5 steps": taking(2.5),
    "took inf steps": taking(math.inf),
    "took nan steps": taking(math.nan),
}


@pytest.mark.parametrize("way", ["kernel", "torch"])
@pytest.mark.parametrize(("message", "damage"), DAMAGE.items(), ids=DAMAGE)
def test_a_damaged_state_is_refused_and_changes_nothing(
    way: str, message: str, damage: Callable[[dict[str, np.ndarray]], None]
) -> None:
    case = Case()
    fit = case.fit(case.model())
    fit.step(case.batch(), 1e-3)
    optimizer = fit if way == "kernel" else Optimizer(case.model(), OptimConfig())
    optimizer.load(fit.state())
    state = fit.state()
    damage(state)
    before = optimizer.state()
    with pytest.raises(ValueError, match=message):
        optimizer.load(state)
    for name, value in optimizer.state().items():
        np.testing.assert_array_equal(value, before[name])


def test_a_state_whose_parameters_took_other_numbers_of_steps_is_refused_by_the_kernel() -> None:
    """Torch's parameters may differ in it: those that a loss leaves out take no step."""
    case = Case()
    fit = case.fit(case.model())
    fit.step(case.batch(), 1e-3)
    state = fit.state() | {"0/1/step": np.array(7, np.float32)}
    with pytest.raises(ValueError, match="took 1 to 7 steps"):
        fit.load(state)
    Optimizer(case.model(), OptimConfig()).load(state)


def test_a_prefix_decides_what_is_computed_but_padding_does_not_matter() -> None:
    """Tokens that no query sees have no effect, whatever they hold."""
    case = Case()
    batch = case.batch()
    loss, gradients = case.fit(case.model()).gradient(batch)
    hidden = np.arange(case.tokens) >= batch.prefix.max(axis=1)[:, None]
    assert hidden.any()
    rewards = np.where(hidden, np.float32(np.nan), batch.rewards)
    own_loss, own = case.fit(case.model()).gradient(replace(batch, rewards=rewards))
    assert own_loss == loss
    for name, gradient in gradients.items():
        np.testing.assert_array_equal(own[name], gradient, err_msg=name)


def test_powers_and_cosines_need_no_library() -> None:
    assert [_power(0.98, n) for n in (0, 1, 2, 7, 2000)] == pytest.approx([0.98**n for n in (0, 1, 2, 7, 2000)], rel=1e-12)
    angles = np.linspace(0, math.pi, 1001)
    assert [cosine(float(x)) for x in angles] == pytest.approx(np.cos(angles).tolist(), abs=1e-14)


def test_sine_and_cosine_are_right_to_the_last_place() -> None:
    x = np.linspace(-60, 60, 100_001).astype(np.float32)
    for own, true in zip(sine_and_cosine(x), (np.sin(x.astype(float)), np.cos(x.astype(float))), strict=True):
        np.testing.assert_array_equal(own, true.astype(np.float32))


def test_a_prefix_beyond_the_context_is_refused() -> None:
    case = Case()
    batch = case.batch()
    for wrong in (-1, case.tokens + 1):
        with pytest.raises(ValueError, match=f"prefixes of .*a context has {case.tokens} tokens"):
            case.fit(case.model()).gradient(replace(batch, prefix=np.full_like(batch.prefix, wrong)))


def test_windows_longer_than_the_models_and_labels_of_another_model_are_refused() -> None:
    """The kernel would write beyond its memory."""
    case = Case(windows=2, window=3)
    fit = case.fit(case.model())
    with pytest.raises(ValueError, match=r"^windows of up to 40 states: model\.window = 3$"):
        fit.gradient(case._replace(window=40).batch())
    with pytest.raises(ValueError, match=r"^arrays of the shapes .*: not those of a batch of this model$"):
        fit.gradient(case._replace(actions=3).batch())


def test_no_thread_writes_to_gradients_after_an_error(monkeypatch: pytest.MonkeyPatch) -> None:
    """The next step would use the same memory."""
    done: list[int] = []

    def add(contexts: Contexts, context: int, *arrays: np.ndarray) -> float:
        if threading.current_thread() is threading.main_thread():
            raise MemoryError
        time.sleep(0.02)
        done.append(context)
        return 0.0

    monkeypatch.setattr(Contexts, "add", add)
    case = Case(contexts=4)
    with pytest.raises(MemoryError):
        case.fit(case.model(), threads=2).gradient(case.batch())
    before = len(done)
    time.sleep(0.1)
    assert len(done) == before >= 3


RECORDED = "8e97486e932da77253dfaa90474489189389cd0477ea2144153992390418687f"
"""SHA-256 of the weights below, recorded on an AMD EPYC with AVX-512."""


def test_weights_have_the_recorded_digest() -> None:
    """Equal on all processors: numpy's draws, then steps of AdamW and Muon, with all that a model can have."""
    whole = hashlib.sha256()
    shapes = Case(heads=2, windows=2, window=3, fourier=2, contexts=18), Case(discrete=False, actions=2, width=20, layers=3)
    for case in shapes:
        model = case.model(scale=0.0)
        model.draw_weights(np.random.default_rng(7))
        fit = KernelFit(case.spec, case.config, OptimConfig(muon=5.0, weight_decay=0.1), weights_of(model), threads=2)
        for seed in range(5):
            fit.step(case.batch(seed), 3e-3)
        for name, weight in sorted(fit.weights.items()):
            whole.update(name.encode() + weight.astype("<f4").tobytes())
    assert whole.hexdigest() == RECORDED


@pytest.mark.parametrize("discrete", [True, False])
@pytest.mark.parametrize("value", [math.nan, math.inf])
def test_a_weight_that_is_no_finite_number_reaches_the_loss(discrete: bool, value: float) -> None:
    case = Case(discrete=discrete)
    names = "embed_transition.weight", "trunk.blocks.0.qkv.weight", "trunk.blocks.1.feed.0.bias", "head.weight", "head.bias"
    for name in names if math.isnan(value) else names[-1:]:
        for place in (0, -1):
            fit = case.fit(case.model())
            fit.weights[name].flat[place] = value
            assert not math.isfinite(fit.gradient(case.batch())[0]), (name, place)


@pytest.mark.parametrize("discrete", [True, False])
@pytest.mark.parametrize("field", ["rewards", "observations", "queries", "labels"])
@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf, 1e30])
def test_values_that_cannot_be_fitted_end_the_fit_as_they_end_torchs(discrete: bool, field: str, value: float) -> None:
    """By the loss of this step or the next, without a warning.  Torch's loss is nan too where a variance overflows."""
    case = Case(discrete=discrete)
    batch = case.batch()
    changed = getattr(batch, field).copy()
    changed.flat[0] = value
    batch = replace(batch, **{field: changed})
    expected, _ = by_torch(case.model(), batch)
    fit = case.fit(case.model())
    if math.isfinite(expected):
        assert math.isfinite(fit.step(batch, 1e-3))
        return
    with pytest.raises(FloatingPointError, match=r"at step [01]: lower the learning rate"):
        take_steps(lambda step, rate: fit.step(batch, rate), OptimConfig(), 1e-3, 5)
