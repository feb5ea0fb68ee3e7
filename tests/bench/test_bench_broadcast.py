"""The broadcast benchmark: every process loads every version, by both methods."""

from __future__ import annotations

import json

import pytest

from icrl_dist.bench import broadcast
from icrl_dist.config.run import ConfigError
from icrl_dist.models.weights import weights_of


@pytest.mark.integration
def test_it_reports_a_ratio_for_each_size() -> None:
    result = broadcast.run(workers=2, pairs=1)
    for size in broadcast.WIDTHS:
        ((ours, theirs),) = result["pairs"][size]
        assert ours > 0 and theirs > 0
        assert result[f"ratio_{size}"] == pytest.approx(ours / theirs, rel=0.02, abs=0.01)
    assert json.loads(json.dumps(result)) == result
    assert f"{result['bytes_12mb']:,}" in broadcast.describe(result)


def test_models_have_the_sizes_that_their_names_state() -> None:
    for size, megabytes in (("1mb", 1), ("12mb", 12)):
        size_bytes = sum(array.nbytes for array in weights_of(broadcast.model(size)).values())
        assert size_bytes == pytest.approx(megabytes * 1e6, rel=0.05)


@pytest.mark.parametrize(("wrong", "message"), [({"workers": 0}, "workers = 0"), ({"pairs": 0}, "pairs = 0")])
def test_invalid_arguments_are_refused(wrong: dict[str, int], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        broadcast.run(**wrong)
