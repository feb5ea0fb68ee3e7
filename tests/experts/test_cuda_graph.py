"""Updates as a CUDA graph: the logic with a fake graph on any machine, the graph itself on a GPU."""

import numpy as np
import pytest
import torch

from icrl_dist.experts.sac import cuda_graph
from icrl_dist.experts.sac.batched import SACBatch, train
from icrl_dist.experts.sac.cuda_graph import GraphedCallable
from icrl_dist.experts.sac.lockstep import Lockstep
from icrl_dist.experts.sac.replay import ReplayBatch
from tests.experts.sac_cases import LINE, PAPER, SMALL, SPEC, Line, N, random_updates


def as_graph(engine, monkeypatch, warm_up=lambda work, times: [work() for _ in range(times)]):
    """Replace the engine's update by a fake graph, which calls the update with the graph's fixed tensors."""
    monkeypatch.setattr(cuda_graph, "warm_up", warm_up)
    monkeypatch.setattr(cuda_graph, "record", lambda work: work)
    engine._step = GraphedCallable(engine._step, lockstep(engine).changed())
    return engine


def lockstep(engine):
    assert isinstance(engine._updater, Lockstep)
    return engine._updater


def updates_of(engine):
    """The number of updates that the tensors of the engine count."""
    return lockstep(engine)._counts[0].item()


@pytest.mark.parametrize("matmul_dtype", ["float32", "bfloat16"])
def test_warm_up_calls_are_undone_and_every_update_is_made(matmul_dtype, monkeypatch):
    """Also when parameters were loaded after the recording."""
    warmed = list[float]()

    def warm(work, times):
        before = updates_of(graphed)
        for _ in range(times):
            work()
        warmed.append(updates_of(graphed) - before)

    direct = SACBatch(range(N), SPEC, SMALL, "cpu", matmul_dtype)
    graphed = as_graph(SACBatch(range(N), SPEC, SMALL, "cpu", matmul_dtype), monkeypatch, warm)
    for batch, noise in random_updates(SMALL, 3):
        direct.update(batch, noise)
        graphed.update(batch, noise)
    assert warmed == [3.0], "warmed up once, with three updates"
    other = SACBatch(range(5, 5 + N), SPEC, SMALL, "cpu", matmul_dtype)
    for batch, noise in random_updates(SMALL, 2, seed=9):
        other.update(batch, noise)
    for engine in (direct, graphed):
        assert updates_of(engine) == engine.updates == 3
        engine.load(other.state())
        for batch, noise in random_updates(SMALL, 3, seed=1):
            engine.update(batch, noise)
        assert updates_of(engine) == engine.updates == 5
    for name, array in direct.arrays.items():
        assert torch.equal(graphed.arrays[name], array), name


def test_a_graph_refuses_other_shapes_and_does_not_change_its_inputs(monkeypatch):

    def add_one(one):
        seen.append(one.clone())
        return one.add_(1)

    seen = list[torch.Tensor]()
    monkeypatch.setattr(cuda_graph, "warm_up", lambda work, times: None)
    monkeypatch.setattr(cuda_graph, "record", lambda work: work)
    graph = GraphedCallable(add_one, [])
    for number in (1.0, 2.0):
        given = torch.full((2,), number)
        graph(given)
        assert given.tolist() == [number, number] and seen[-1].tolist() == [number, number]
    with pytest.raises(ValueError, match=r"recorded for \[\(2,\)\], not \[\(1,\)\]"):
        graph(torch.ones(1))


def test_an_update_keeps_the_memory_of_every_tensor():
    """A graph writes to the addresses that it was recorded with."""
    engine = SACBatch(range(N), SPEC, SMALL, "cpu", "bfloat16")
    before = [one.data_ptr() for one in lockstep(engine).changed()]
    assert len(before) == 10 + 3 + 3 and len(set(before)) == len(before)  # arrays, counts, copies in bfloat16
    for batch, noise in random_updates(SMALL, 2):
        engine.update(batch, noise)
    engine.load(engine.state())
    assert [one.data_ptr() for one in lockstep(engine).changed()] == before


cuda = pytest.mark.skipif(not torch.cuda.is_available(), reason="no GPU")


def updates_on_gpu(config, updates, **more):
    for batch, noise in random_updates(config, updates, **more):
        yield ReplayBatch(*(column.cuda() for column in batch)), noise.cuda()


def assert_close(first, second, actors=6e-6, critics=4e-5):
    """The parameters of two engines, on any devices, are equal up to rounding."""
    for name, tolerance in (("actor", actors), ("critic", critics), ("target", critics), ("log_temperature", 1e-5)):
        difference = float((first.arrays[name].cpu() - second.arrays[name].cpu()).abs().max())
        print(f"{name}: difference {difference:.1e}")
        assert difference <= tolerance, name


@cuda
@pytest.mark.parametrize("matmul_dtype", ["float32", "bfloat16"])
def test_updates_with_and_without_a_graph_agree(matmul_dtype):
    graphed, direct = (SACBatch(range(N), SPEC, PAPER, "cuda", matmul_dtype, graph=graph) for graph in (True, False))
    assert isinstance(graphed._step, GraphedCallable) and not isinstance(direct._step, GraphedCallable)
    for batch, noise in updates_on_gpu(PAPER, 10):
        graphed.update(batch, noise)
        direct.update(batch, noise)
    assert updates_of(graphed) == updates_of(direct) == 10
    assert_close(graphed, direct)


@cuda
def test_updates_on_gpu_and_cpu_agree():
    there, here = SACBatch(range(N), SPEC, PAPER, "cuda"), SACBatch(range(N), SPEC, PAPER, "cpu")
    assert_close(there, here, 0, 0)
    for (batch, noise), (batch_, noise_) in zip(updates_on_gpu(PAPER, 10), random_updates(PAPER, 10), strict=True):
        there.update(batch, noise)
        here.update(batch_, noise_)
    assert_close(there, here, 3 * 6e-6, 3 * 4e-5)


@cuda
def test_a_graph_uses_parameters_loaded_after_its_recording():
    first, other, later = (SACBatch(range(seed, seed + N), SPEC, SMALL, "cuda") for seed in (0, 10, 20))
    for engine, seed in ((first, 3), (other, 4)):
        for batch, noise in updates_on_gpu(SMALL, 3, seed=seed):
            engine.update(batch, noise)
    state = first.state()
    other.load(state)  # its graph is recorded already
    later.load(state)  # its graph is not recorded yet
    for batch, noise in updates_on_gpu(SMALL, 5, seed=5):
        for engine in (first, other, later):
            engine.update(batch, noise)
    for engine in (other, later):
        assert engine.updates == 8 and updates_of(engine) == 8
        assert_close(engine, first)
    assert float((first.arrays["actor"].cpu() - torch.from_numpy(state["actor"])).abs().max()) > 1e-4


@cuda
def test_training_on_a_gpu_continues_from_a_state():
    states = {}

    def save_state(engine, returns):
        states[engine.steps] = engine.state()

    whole = train(Line(2), LINE, 35, [5, 6], save_state, "cuda")
    again = train(Line(2), LINE, 35, [5, 6], device="cuda", state=states[14])
    assert whole.updates == again.updates == 8
    np.testing.assert_allclose(again.replay.state()["rows"], whole.replay.state()["rows"], atol=1e-3)
    assert_close(again, whole, 1e-3, 1e-3)
