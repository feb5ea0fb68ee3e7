"""Examples that are read when they are drawn: memory is bounded, and the draws are the same."""

import numpy as np
import pytest

from icrl_dist.training.batches import Pool, Shelf, Shelved, draw
from tests.training.test_batches import examples


@pytest.mark.parametrize("kept", [0, 1, 3, 100])
def test_a_shelf_keeps_the_last_used_within_its_budget_and_draws_the_same(kept):
    everything = {key: examples(key + 1, 4) for key in range(6)}
    budget = kept * everything[0].nbytes
    reads = []

    def read(key):
        reads.append(key)
        return everything[key]

    shelf = Shelf(budget, read)
    shelved = Shelved(shelf, list(everything))
    for n in range(20):
        one, two = (draw(np.random.default_rng(n), [Pool(1.0, p, 3)], 8, 4) for p in (shelved, [*everything.values()]))
        for name in ("observations", "actions", "rewards", "queries", "labels", "prefix"):
            np.testing.assert_array_equal(getattr(one, name), getattr(two, name))
        assert shelf.nbytes <= max(budget, everything[0].nbytes)
    if kept >= 6:
        assert sorted(reads) == list(everything), "an example is read twice although there is memory for all"
    else:
        assert len(reads) > 6
    reads.clear()
    last = shelved[2]
    assert shelved[2] is last and len(reads) <= 1
    assert list(shelved[:2]) == [everything[0], everything[1]] and len(shelved) == 6
