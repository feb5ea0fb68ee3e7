"""Contract: arrays are copied in and copied out.

Garbage is written into every array that was an argument, after the call, and into every array that was returned, after a
look at it.  All results are as without.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

import icrl_dist
from tests.hands.subjects import SUBJECTS, Subject, leaves, plain
from tests.jobs import collected
from tests.storage.test_reading import stored


def spoil(value: Any) -> int:
    """Write garbage into every array that can be written; returns their number."""
    writeable = [array for array in leaves(value) if array.flags.writeable and array.size]
    for array in writeable:
        array[...] = -7 if array.dtype.kind in "iu" else np.nan if array.dtype.kind == "f" else True
    return len(writeable)


def results(subject: Subject, garbage: bool) -> tuple[list[Any], int]:
    """The results of some turns, and the number of arrays that garbage was written into."""
    found: list[Any] = []
    one, spoiled = subject.make(), 0

    def call(function: Callable[..., Any], *arguments: Any) -> Any:
        nonlocal spoiled
        given = [argument.copy() if isinstance(argument, np.ndarray) else argument for argument in arguments]
        result = function(*given)
        found.append(plain(result))
        kept = np.array(result) if isinstance(result, np.ndarray) else None
        if garbage:
            spoiled += spoil(result) + spoil([array for array in given if isinstance(array, np.ndarray)])
        return kept

    for number in range(12):
        subject.turn(one, call, number)
    return found, spoiled


WITHOUT_ARRAYS = ("run", "problem", "variation", "null", "interrupted", "failed")


@pytest.mark.parametrize("subject", SUBJECTS, ids=lambda subject: subject.name)
def test_what_a_caller_writes_into_arrays_changes_nothing(subject: Subject) -> None:
    untouched, _ = results(subject, garbage=False)
    spoiled, written = results(subject, garbage=True)
    assert spoiled == untouched
    assert written or subject.name.startswith(WITHOUT_ARRAYS), "no array was written: the test shows nothing"


def test_what_a_caller_writes_into_trajectories_and_rows_changes_no_later_reading(small_run, tmp_path):
    with icrl_dist.read_dataset(stored(tmp_path, collected(small_run, 2))) as data:
        before, frame = [plain(one.arrays()) for one in data], data.steps()
        expected = frame.copy()
        for one in data:
            spoil(one)
        frame.loc[:, "reward"] = -1.0
        assert [plain(one.arrays()) for one in data] == before
        assert data.steps().equals(expected)


def test_a_result_that_a_caller_changes_is_not_read_again():
    agent = icrl_dist.load_agent("darkroom", seed=0)
    agent.manifest["test_goals"].clear()
    assert icrl_dist.load_agent("darkroom").manifest["test_goals"]
