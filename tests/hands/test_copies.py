"""Contract: a copy of anything public acts like the original and shares no state with it, or copying is refused.

Original and copy are used in turn, by equal calls, and give equal results, which are those of one that was never copied.
"""

from __future__ import annotations

import copy
import os
import pickle
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

import icrl_dist
from icrl_dist.problems import registry
from tests.hands.subjects import SUBJECTS, Subject, plain
from tests.jobs import collected
from tests.problems.test_gym_adapter import pushed
from tests.storage.test_reading import stored

WAYS: dict[str, Callable[[Any], Any]] = {
    "deepcopy": copy.deepcopy,
    "copy": copy.copy,
    "pickle": lambda one: pickle.loads(pickle.dumps(one)),
}


def used(subject: Subject, one: Any, turns: range) -> list[Any]:
    results: list[Any] = []

    def call(function: Callable[..., Any], *arguments: Any) -> Any:
        result = function(*arguments)
        results.append(plain(result))
        return result

    for number in turns:
        subject.turn(one, call, number)
    return results


@pytest.mark.parametrize("subject", SUBJECTS, ids=lambda subject: subject.name)
def test_a_copy_acts_like_the_original_and_shares_nothing_with_it(subject: Subject) -> None:
    never_copied = used(subject, subject.make(), range(12))
    original = subject.make()
    results = used(subject, original, range(3))
    copies = {way: make(original) for way, make in WAYS.items()}
    for number in range(3, 12):
        of_original = used(subject, original, range(number, number + 1))
        for way, copied in copies.items():
            assert used(subject, copied, range(number, number + 1)) == of_original, f"{way}, turn {number}"
        results += of_original
    assert results == never_copied


@pytest.mark.parametrize("way", WAYS)
def test_an_open_dataset_is_not_copied(way: str, small_run: icrl_dist.Run, tmp_path: Path) -> None:
    with icrl_dist.read_dataset(stored(tmp_path, collected(small_run, 2))) as data:
        with pytest.raises(TypeError, match=r"StoredData cannot be copied.*read_dataset"):
            WAYS[way](data)
        assert pickle.loads(pickle.dumps(next(iter(data)))).identity == next(iter(data)).identity


@pytest.mark.integration
def test_an_unpickled_simulation_acts_the_same_in_another_process(tmp_path: Path) -> None:
    env = registry.make(pushed("dmc-walker-run")())
    env.reset(seed=0)
    env.action_space.seed(0)
    (tmp_path / "env").write_bytes(pickle.dumps(env))
    script = (
        "import pickle, sys\nenv = pickle.load(open(sys.argv[1], 'rb'))\n"
        "print([env.step(env.action_space.sample())[0].tobytes() for _ in range(5)])"
    )
    environ = {name: value for name, value in os.environ.items() if name != "MUJOCO_GL"}
    words = [sys.executable, "-c", script, str(tmp_path / "env")]
    ran = subprocess.run(words, capture_output=True, text=True, check=True, env=environ)
    assert ran.stdout.strip() == str([env.step(env.action_space.sample())[0].tobytes() for _ in range(5)])
