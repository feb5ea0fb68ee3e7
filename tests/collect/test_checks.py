"""Checks of a trajectory's arrays: a value that is out of bounds in any of them is refused with the array's name."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from icrl_dist.collect.adapt import LabelledRollouts, Rollouts
from icrl_dist.collect.checks import Rejected, check, check_arrays, largest
from icrl_dist.config.run import Run
from icrl_dist.experts.payloads import ExpertLabelling
from icrl_dist.interfaces import Limits
from icrl_dist.problems import registry
from icrl_dist.problems.darkroom.labels import RoomLabelling
from icrl_dist.problems.registry import of_task
from icrl_dist.types import ARRAYS, NULL, Adversary, Identity, Job, LabelCounts, Spec, Task, Trajectory, Variation
from tests.jobs import do, jobs_of

ROOM = Spec((0.0, 0.0), (2.0, 2.0), 5, 8)
ARM = Spec((-1.0, -1.0), (1.0, 1.0), 3, 8, discrete=False)
LIMITS = Limits(reward=(0.0, 1.0), slack=10.0, disturbances=2)


def example(spec: Spec, queries: int = 4, adversary: Adversary = NULL) -> tuple[Trajectory, Job]:
    """A valid trajectory of a job that says nothing about labels."""
    rng, h, a = np.random.default_rng(0), spec.horizon, spec.actions
    variation = Variation(Task.of("darkroom", size=3, horizon=8, goal=(1, 1)), adversary)

    def actions(count: int) -> np.ndarray:
        if spec.discrete:
            return rng.integers(0, a, count).astype(np.int16)
        return rng.uniform(-1, 1, (count, a)).astype(np.float32)

    labels = np.full((queries, a), 1 / a, np.float32) if spec.discrete else actions(queries)
    made = Trajectory(
        identity=Identity("pretrain", 0, 0, 0, 0),
        variation=variation,
        policy_version=-1,
        weights_digest="",
        worker="w",
        actions=actions(h),
        observations=rng.uniform(0, 1, (h + 1, spec.observation)).astype(np.float32),
        rewards=rng.random(h, np.float32),
        adversary=np.full(h, -1, np.int16) if spec.discrete else np.zeros((h, 2), np.float32),
        queries=rng.uniform(0, 1, (queries, spec.observation)).astype(np.float32),
        labels=labels,
        prev_actions=actions(2),
        prev_rewards=rng.random(2, np.float32),
        origin="optimal",
    )
    return made, Job("kind", "pretrain", 0, 0, (variation,), 1, -1, 0)


def outside(spec: Spec, name: str) -> st.SearchStrategy[float]:
    """Values that the array of this name cannot have."""
    if name == "labels" and spec.discrete:
        return st.sampled_from([-1e-2, 2.0, 3e38, np.nan, np.inf, -np.inf])
    if ARRAYS[name][0] == "<i2" and spec.discrete:
        return st.sampled_from([-2, 5, 32767, -32768])
    return st.sampled_from([3e38, -3e38, 1e9, np.nan, np.inf, -np.inf])


@settings(max_examples=200, deadline=None)
@given(spec=st.sampled_from([ROOM, ARM]), name=st.sampled_from([*ARRAYS]), data=st.data())
def test_a_value_that_is_out_of_bounds_is_refused_with_the_name_of_its_array(
    spec: Spec, name: str, data: st.DataObject
) -> None:
    trajectory, job = example(spec)
    check_arrays(trajectory, job, spec, LIMITS)
    array = getattr(trajectory, name).copy()
    place = data.draw(st.integers(0, array.size - 1))
    array.flat[place] = data.draw(outside(spec, name))
    with pytest.raises(Rejected, match=rf"^(spec|not-finite): .*: {name}\["):
        check_arrays(dataclasses.replace(trajectory, **{name: array}), job, spec, LIMITS)


def test_labels_of_discrete_actions_are_distributions() -> None:
    trajectory, job = example(ROOM)
    with pytest.raises(Rejected, match=r"labels\[1\] has the sum 1\.2"):
        labels = trajectory.labels.copy()
        labels[1, 0] = 0.4
        check_arrays(dataclasses.replace(trajectory, labels=labels), job, ROOM, LIMITS)


def test_the_null_adversary_does_nothing_and_a_network_stays_within_its_strength() -> None:
    trajectory, job = example(ROOM, adversary=Adversary.of("uniform", p=0.1))
    acted = dataclasses.replace(trajectory, adversary=np.full(8, 4, np.int16))
    check_arrays(acted, job, ROOM, LIMITS)
    with pytest.raises(Rejected, match=r"adversary\[0\] = 4 lies outside -1\.\.-1"):
        check_arrays(dataclasses.replace(acted, variation=Variation(acted.variation.task)), job, ROOM, LIMITS)
    strong, job = example(ARM, adversary=Adversary.of("network", strength=0.5))
    check_arrays(dataclasses.replace(strong, adversary=np.full((8, 2), -0.5, np.float32)), job, ARM, LIMITS)
    with pytest.raises(Rejected, match=r"adversary\[0, 0\] = 0\.6 lies outside"):
        check_arrays(dataclasses.replace(strong, adversary=np.full((8, 2), 0.6, np.float32)), job, ARM, LIMITS)


LABELLINGS = [
    (RoomLabelling("soft", 0.9, 0.1, 4, 2, 3, 0.0, ()), LabelCounts(10, 6, "optimal")),
    (RoomLabelling("heuristic", 0.9, 0.1, 4, 1, 0, 0.0, ()), LabelCounts(4, 0, "heuristic")),
    (ExpertLabelling(7, 2, 1, 0.0), LabelCounts(9, 2, "expert")),
]


@pytest.mark.parametrize(("labelling", "counts"), LABELLINGS)
def test_the_job_says_how_many_labels_its_trajectories_have(labelling: object, counts: LabelCounts) -> None:
    assert LabelledRollouts(40, "paper", "auto", 0.0, 0, labelling).labels == counts
    assert Rollouts(40, "paper", "auto", 0.0, 0).labels == LabelCounts(0, 0, "none")
    assert LabelledRollouts(40, "paper", "auto", 0.0, 0, object()).labels is None


@pytest.mark.parametrize("count", [0, 3, 5, 8000])
def test_other_numbers_of_queries_and_another_origin_are_refused(module_run: Run, count: int) -> None:
    job = jobs_of(module_run, "icag")[0]
    trajectory, spec, limits = do(module_run, job)[0], registry.of(module_run).spec, registry.of(module_run).limits
    check(trajectory, job, spec, "", limits)
    rows = np.resize(np.arange(4), count)
    other = dataclasses.replace(trajectory, queries=trajectory.queries[rows], labels=trajectory.labels[rows])
    with pytest.raises(Rejected, match=rf"queries = {count}, its job asks for 4"):
        check(other, job, spec, "", limits)
    with pytest.raises(Rejected, match=r"origin = 'expert', its job asks for 'optimal'"):
        check(dataclasses.replace(trajectory, origin="expert"), job, spec, "", limits)


@pytest.mark.parametrize(
    ("kind", "rewards"), [("darkroom", (0, 1)), ("dmc-walker-run", (0, 1)), ("metaworld-pick-place", (-1, 11))]
)
def test_each_problem_states_its_rewards(kind: str, rewards: tuple[float, float]) -> None:
    assert of_task(Task.of(kind)).limits.reward == rewards


def test_the_largest_value_of_a_fits_data_is_named() -> None:
    small, _ = example(ROOM)
    large = dataclasses.replace(small, identity=Identity("adapt", 1, 2, 3, 4), rewards=np.full(8, 9e5, np.float32))
    later = dataclasses.replace(large, identity=Identity("adapt", 2, 0, 0, 0), rewards=np.full(8, 1e6, np.float32))
    found = largest(iter([small, large, later]), ROOM, lambda t: t.identity.next_version <= 2)
    assert found == "adapt/1/2/3/4, whose rewards reach 900000"
    assert largest(iter([]), ROOM, lambda t: True) == ""
