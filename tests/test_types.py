"""Parameters, identities, their random streams, jobs; and shapes are checked in tests."""

from __future__ import annotations

import dataclasses
import itertools
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
import pytest
from jaxtyping import TypeCheckError

from icrl_dist.problems.darkroom.solver import cell_numbers
from icrl_dist.types import ARRAYS, NULL, STAGES, Adversary, Identity, Job, Payload, Spec, Task, Trajectory, Variation


def trajectory(horizon: int = 3, **changes: Any) -> Trajectory:
    values: dict[str, Any] = {
        "identity": Identity("pretrain", 0, 0, 0, 0),
        "variation": Variation(Task.of("darkroom", size=3)),
        "policy_version": -1,
        "weights_digest": "",
        "worker": "test",
        "observations": np.zeros((horizon + 1, 2), np.float32),
        "actions": np.zeros(horizon, np.int16),
        "rewards": np.zeros(horizon, np.float32),
        "adversary": np.full(horizon, -1, np.int16),
        "queries": np.zeros((0, 2), np.float32),
        "labels": np.zeros((0, 5), np.float32),
        "prev_actions": np.zeros(0, np.int16),
        "prev_rewards": np.zeros(0, np.float32),
        "origin": "none",
    }
    return Trajectory(**{**values, **changes})


def test_shapes_are_checked_while_testing() -> None:
    with pytest.raises(TypeCheckError):
        cell_numbers(np.zeros((4, 3), np.float32), 3)
    with pytest.raises(TypeCheckError):
        trajectory(actions=np.zeros(2, np.int16))
    with pytest.raises(TypeCheckError):
        trajectory(rewards=np.zeros(3, np.float64))


def test_params_are_sorted_python_values() -> None:
    a = Task.of("darkroom", size=np.int64(3), goal=np.array([1, 2]), gamma=np.float32(0.5), name="x")
    b = Task.of("darkroom", name="x", goal=[1, 2], gamma=0.5, size=3)
    assert a == b
    assert hash(a) == hash(b)
    assert a.params == (("gamma", 0.5), ("goal", (1, 2)), ("name", "x"), ("size", 3))
    assert [type(v) for _, v in a.params] == [float, tuple, str, int]
    assert [type(v) for v in a.vector("goal")] == [int, int]


@pytest.mark.parametrize("value", [{"a": 1}, None, [[1, 2], [3, 4]], np.eye(2), ["a", "b"], 1j])
def test_params_refuse_values_that_messages_cannot_carry(value: object) -> None:
    with pytest.raises(TypeError, match="parameter odd="):
        Task.of("darkroom", odd=value)


def test_reading_params() -> None:
    task = Task.of("darkroom", size=3, goal=(1, 2), name="x", flag=True)
    assert (task["size"], task.number("size"), task.vector("goal")) == (3, 3, (1, 2))
    assert (task.get("size", 9), task.get("width", 9)) == (3, 9)
    with pytest.raises(KeyError, match=r"'width'.*flag, goal, name, size"):
        task["width"]
    for name in ("goal", "name", "flag"):
        with pytest.raises(TypeError, match=f"{name}=.*not a number"):
            task.number(name)
    with pytest.raises(TypeError, match="size=3 is not a list"):
        task.vector("size")


def test_replace_keeps_the_type_and_the_other_parameters() -> None:
    task = Task.of("darkroom", size=3, goal=(1, 2))
    other = task.replace(goal=[0, 0], start=(1, 1))
    assert other == Task.of("darkroom", goal=(0, 0), size=3, start=(1, 1))
    assert type(other) is Task
    assert task["goal"] == (1, 2)
    null_task: object = Task("null")
    assert null_task != NULL, "a task equals an adversary of the same kind"


IDENTITIES = [Identity(s, *rest) for s in STAGES for rest in itertools.product((0, 1, 2, 11), repeat=4)]


def test_identity_parses_its_own_text() -> None:
    assert all(Identity.parse(str(i)) == i for i in IDENTITIES)
    assert str(Identity("adapt", 1, 2, 3, 40)) == "adapt/1/2/3/40"
    assert [type(v) for v in Identity.parse("adapt/1/2/3/40")] == [str, int, int, int, int]


@pytest.mark.parametrize(
    "text", ["", "adapt", "adapt/1/2/3", "adapt/1/2/3/4/5", "dream/1/2/3/4", "adapt/-1/2/3/4", "adapt/1/x/3/4", "adapt/²/2/3/4"]
)
def test_identity_refuses_other_text(text: str) -> None:
    with pytest.raises(ValueError, match="expected STAGE/ROUND/TASK/VARIATION/TRIAL"):
        Identity.parse(text)


def test_every_identity_and_seed_has_its_own_random_stream() -> None:
    keys = {i.key() for i in IDENTITIES}
    assert len(keys) == len(IDENTITIES)
    draws = {(seed, i): i.rng(seed).integers(2**63) for i in IDENTITIES for seed in (0, 1)}
    assert len(set(draws.values())) == len(draws)
    assert all(i.rng(seed).integers(2**63) == value for (seed, i), value in draws.items())


def test_keys_sort_in_canonical_order() -> None:
    assert sorted(IDENTITIES, key=Identity.key) == IDENTITIES


def test_a_trajectory_has_the_arrays_of_the_message_format() -> None:
    one = trajectory(rewards=np.array([0, 1, 1], np.float32))
    assert list(one.arrays()) == list(ARRAYS)
    for name, array in one.arrays().items():
        assert array is getattr(one, name)
        assert (array.dtype.str, array.ndim) == ARRAYS[name]
    assert one.episode_return == 2.0


@dataclass(frozen=True)
class Rate(Payload):
    kind: ClassVar[str] = "adapt"
    rate: float


def test_a_job_lists_every_trajectory_that_it_delivers() -> None:
    job = Job("adapt", "adapt", 2, 5, (Variation(Task.of("darkroom")),) * 3, 4, 1, 0, Rate(0.5))
    identities = list(job.identities())
    assert identities == [Identity("adapt", 2, 5, v, t) for v in range(3) for t in range(4)]
    assert job.payload == Rate(0.5) and hash(job) == hash(dataclasses.replace(job, payload=Rate(0.5)))
    assert job != dataclasses.replace(job, payload=Rate(0.25))
    assert (job.name, job.label) == (("adapt", 2, 5, 0), "adapt/2/5")
    with pytest.raises(dataclasses.FrozenInstanceError):
        job.payload.rate = 1.0  # type: ignore[misc]


def test_a_job_of_one_variation_keeps_the_number_of_that_variation() -> None:
    tasks = tuple(
        Variation(Task.of("darkroom", goal=(g, g)), Adversary.of("uniform", p=p)) for g in range(2) for p in (0.0, 0.5)
    )
    whole = Job("adapt", "adapt", 0, 4, tasks, 2, 0, 0, tasks=2)
    for row, (task, variation) in enumerate(whole.rows()):
        one = dataclasses.replace(whole, task=task, variations=(tasks[row],), tasks=1, first=variation)
        assert list(one.identities()) == [Identity("adapt", 0, task, variation, trial) for trial in range(2)]
        assert {one.variation(identity) for identity in one.identities()} == {tasks[row]}
        assert all(whole.variation(identity) == tasks[row] for identity in one.identities())
        assert (one.name, one.label) == (("adapt", 0, task, variation), f"adapt/0/{task}/{variation}")


def test_spec_counts_components() -> None:
    assert Spec(low=(0.0, 0.0, -1.0), high=(1.0, 1.0, 1.0), actions=5, horizon=9).observation == 3
