"""Deployments by the compiled decoder in several threads, in copies and in forked processes, and the memory that they take."""

from __future__ import annotations

import copy
import gc
import multiprocessing
import pickle
import threading
from collections.abc import Callable

import numpy as np
import psutil
import pytest

from icrl_dist.models.compiled import kinds
from icrl_dist.models.deployed import Deployed
from tests.models.random_networks import columns, window
from tests.models.test_kernel import SPEC, deployed, small

pytestmark = pytest.mark.skipif(not kinds(), reason="the decoder was not compiled, or not for this processor")


def test_one_deployment_in_several_threads_neither_ends_the_process_nor_mixes_up_decisions() -> None:
    of, rng = small(batch=20, width=32), np.random.default_rng(5)
    context, states = columns(rng, SPEC, 20, 100), columns(rng, SPEC, 20, 1).observations[:, 0]
    shared, alone = deployed(of), deployed(of)
    shared.append(context)
    alone.append(context)
    expected = alone.decide(states).tobytes()
    found: set[bytes] = set()

    def decide() -> None:
        found.update(shared.decide(states).tobytes() for _ in range(200))

    def grow() -> None:
        own = deployed(of)
        for _ in range(12):
            own.append(context)
            own.decide(states)

    work(decide, decide, grow)
    assert found == {expected}

    def extend() -> None:
        for _ in range(12):
            shared.append(context)

    work(decide, extend, extend)  # decisions of growing contexts: any of them, but no end of the process
    assert shared.length == 2500 and np.isfinite(shared.decide(states)).all()


def work(*functions: Callable[[], None]) -> None:
    threads = [threading.Thread(target=function) for function in functions]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()


@pytest.mark.parametrize("copied", [copy.copy, copy.deepcopy, lambda one: pickle.loads(pickle.dumps(one))])
def test_copies_decide_as_the_original_and_share_nothing(copied: Callable[[Deployed], Deployed]) -> None:
    of, rng = small(window=4), np.random.default_rng(6)
    one, states = deployed(of), columns(rng, SPEC, 3, 1).observations[:, 0]
    one.append(columns(rng, SPEC, 3, 140))
    one.decide_window(window(columns(rng, SPEC, 3, 4)))
    other, before = copied(one), one.decide(states)
    assert other.decide(states).tobytes() == before.tobytes()
    other.append(columns(rng, SPEC, 3, 20))
    other.clear()
    assert one.decide(states).tobytes() == before.tobytes() and one.length == 140


def test_a_deployment_decides_in_a_forked_process() -> None:
    of, rng = small(), np.random.default_rng(7)
    one, states = deployed(of), columns(rng, SPEC, 3, 1).observations[:, 0]
    one.append(columns(rng, SPEC, 3, 50))
    context = multiprocessing.get_context("fork")
    receiver, sender = context.Pipe(duplex=False)
    child = context.Process(target=lambda: sender.send(one.decide(states).tobytes()))
    child.start()
    try:
        assert receiver.poll(30) and receiver.recv() == one.decide(states).tobytes()
    finally:
        child.join()


def test_deployments_give_their_memory_back() -> None:
    of, rng = small(batch=20, width=32), np.random.default_rng(8)
    context = columns(rng, SPEC, 20, 10)

    def make(count: int) -> int:
        for _ in range(count):
            deployed(of).append(context)
        gc.collect()
        return psutil.Process().memory_info().rss

    before = make(50)
    grown = make(200) - before
    assert grown < 20e6, "200 contexts of 2 layers x 20 x 128 x 32 numbers take 131 MB"
