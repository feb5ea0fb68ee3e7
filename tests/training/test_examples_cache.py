"""The cache of examples bounds the memory and does not change what is drawn."""

import numpy as np
import pytest

from icrl_dist.training.batches import CachedExamples, ExamplesCache, Pool, draw
from tests.training.test_batches import examples


@pytest.mark.parametrize("fitting", [0, 1, 3, 100])
def test_the_cache_keeps_the_last_used_within_its_budget_and_does_not_change_the_draws(fitting):
    everything = {key: examples(key + 1, 4) for key in range(6)}
    budget = fitting * everything[0].nbytes
    reads = []

    def read(key):
        reads.append(key)
        return everything[key]

    cache = ExamplesCache(budget, read)
    cached = CachedExamples(cache, list(everything))
    for n in range(20):
        one, two = (draw(np.random.default_rng(n), [Pool(1.0, p, 3)], 8, 4) for p in (cached, [*everything.values()]))
        for name in ("observations", "actions", "rewards", "queries", "labels", "prefix"):
            np.testing.assert_array_equal(getattr(one, name), getattr(two, name))
        assert cache.nbytes <= max(budget, everything[0].nbytes)
    if fitting >= 6:
        assert sorted(reads) == list(everything), "an example is read twice although all examples fit into memory"
    else:
        assert len(reads) > 6
    reads.clear()
    last = cached[2]
    assert cached[2] is last and len(reads) <= 1
    assert list(cached[:2]) == [everything[0], everything[1]] and len(cached) == 6
