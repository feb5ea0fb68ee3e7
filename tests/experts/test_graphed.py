"""Updates as a CUDA graph: the logic with a stand-in on any machine, the graph itself where there is a GPU."""

import numpy as np
import pytest
import torch

from icrl_dist.experts.sac import graphed
from icrl_dist.experts.sac.batched import SACBatch, train
from icrl_dist.experts.sac.graphed import Graphed
from icrl_dist.experts.sac.replay import Transitions
from tests.experts.test_batched import LINE, PAPER, SMALL, SPEC, Line, N, drawn


def as_graph(engine, monkeypatch, on_warm=lambda work, times: [work() for _ in range(times)]):
    """The engine's updates by way of a graph's fixed tensors; what stands in for the graph is the work itself."""
    monkeypatch.setattr(graphed, "warm", on_warm)
    monkeypatch.setattr(graphed, "record", lambda work: work)
    engine._step = Graphed(engine._step, engine._updater.changed())
    return engine


@pytest.mark.parametrize("products", ["float32", "bfloat16"])
def test_what_is_done_before_a_recording_is_undone_and_every_update_is_real(products, monkeypatch):
    """Also when parameters were loaded after it."""
    warmed = []

    def warm(work, times):
        before = through._updater._counts[0].item()
        for _ in range(times):
            work()
        warmed.append(through._updater._counts[0].item() - before)

    plain = SACBatch(range(N), SPEC, SMALL, "cpu", products)
    through = as_graph(SACBatch(range(N), SPEC, SMALL, "cpu", products), monkeypatch, warm)
    for batch, noise in drawn(SMALL, 3):
        plain.update(batch, noise)
        through.update(batch, noise)
    assert warmed == [3.0], "warmed up once, and really"
    other = SACBatch(range(5, 5 + N), SPEC, SMALL, "cpu", products)
    for batch, noise in drawn(SMALL, 2, seed=9):
        other.update(batch, noise)
    for engine in (plain, through):
        assert engine._updater._counts[0] == engine.updates == 3
        engine.load(other.state())
        for batch, noise in drawn(SMALL, 3, seed=1):
            engine.update(batch, noise)
        assert engine._updater._counts[0] == engine.updates == 5
    for name, array in plain.arrays.items():
        assert torch.equal(through.arrays[name], array), name


def test_a_graph_is_given_the_shapes_it_was_recorded_with_and_leaves_what_it_is_given(monkeypatch):
    seen = []
    monkeypatch.setattr(graphed, "warm", lambda work, times: None)
    monkeypatch.setattr(graphed, "record", lambda work: work)
    graph = Graphed(lambda one: seen.append(one.clone()) or one.add_(1), [])
    for number in (1.0, 2.0):
        given = torch.full((2,), number)
        graph(given)
        assert given.tolist() == [number, number] and seen[-1].tolist() == [number, number]
    with pytest.raises(ValueError, match=r"recorded for \[\(2,\)\], not \[\(1,\)\]"):
        graph(torch.ones(1))


def test_an_update_keeps_every_tensor_in_its_place():
    """A graph writes to the places it was recorded with."""
    engine = SACBatch(range(N), SPEC, SMALL, "cpu", "bfloat16")
    before = [one.data_ptr() for one in engine._updater.changed()]
    assert len(before) == 10 + 3 + 3 and len(set(before)) == len(before)  # arrays, counts, copies in bfloat16
    for batch, noise in drawn(SMALL, 2):
        engine.update(batch, noise)
    engine.load(engine.state())
    assert [one.data_ptr() for one in engine._updater.changed()] == before


cuda = pytest.mark.skipif(not torch.cuda.is_available(), reason="no GPU here")


def on_gpu(config, updates, **more):
    for batch, noise in drawn(config, updates, **more):
        yield Transitions(*(column.cuda() for column in batch)), noise.cuda()


def near(one, other, actors=6e-6, critics=4e-5):
    """Whether the parameters of two engines, on any device, are the same up to rounding."""
    for name, most in (("actor", actors), ("critic", critics), ("target", critics), ("log_temperature", 1e-5)):
        apart_ = float((one.arrays[name].cpu() - other.arrays[name].cpu()).abs().max())
        print(f"{name}: {apart_:.1e} apart")
        assert apart_ <= most, name


@cuda
@pytest.mark.parametrize("products", ["float32", "bfloat16"])
def test_a_graph_updates_as_the_same_work_without_it(products):
    through, plain = (SACBatch(range(N), SPEC, PAPER, "cuda", products, graph=graph) for graph in (True, False))
    assert isinstance(through._step, Graphed) and not isinstance(plain._step, Graphed)
    for batch, noise in on_gpu(PAPER, 10):
        through.update(batch, noise)
        plain.update(batch, noise)
    assert through._updater._counts[0].item() == plain._updater._counts[0].item() == 10
    near(through, plain)


@cuda
def test_a_gpu_updates_as_a_cpu_does():
    there, here = SACBatch(range(N), SPEC, PAPER, "cuda"), SACBatch(range(N), SPEC, PAPER, "cpu")
    near(there, here, 0, 0)
    for (batch, noise), (batch_, noise_) in zip(on_gpu(PAPER, 10), drawn(PAPER, 10), strict=True):
        there.update(batch, noise)
        here.update(batch_, noise_)
    near(there, here, 3 * 6e-6, 3 * 4e-5)


@cuda
def test_a_graph_takes_up_what_is_loaded_after_it_was_recorded():
    first, other, later = (SACBatch(range(seed, seed + N), SPEC, SMALL, "cuda") for seed in (0, 10, 20))
    for engine, seed in ((first, 3), (other, 4)):
        for batch, noise in on_gpu(SMALL, 3, seed=seed):
            engine.update(batch, noise)
    state = first.state()
    other.load(state)  # it has a graph
    later.load(state)  # it has none yet
    for batch, noise in on_gpu(SMALL, 5, seed=5):
        for engine in (first, other, later):
            engine.update(batch, noise)
    for engine in (other, later):
        assert engine.updates == 8 and engine._updater._counts[0].item() == 8
        near(engine, first)
    assert float((first.arrays["actor"].cpu() - torch.from_numpy(state["actor"])).abs().max()) > 1e-4


@cuda
def test_a_training_on_a_gpu_goes_on_from_a_state():
    kept = {}

    def keep(engine, returns):
        kept[engine.steps] = engine.state()

    whole = train(Line(2), LINE, 35, [5, 6], keep, "cuda")
    again = train(Line(2), LINE, 35, [5, 6], device="cuda", state=kept[14])
    assert whole.updates == again.updates == 8
    np.testing.assert_allclose(again.replay.state()["rows"], whole.replay.state()["rows"], atol=1e-3)
    near(again, whole, 1e-3, 1e-3)
