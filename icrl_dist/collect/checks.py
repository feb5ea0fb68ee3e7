"""The arrays of a valid trajectory: their shapes and values follow from the spec, the problem's limits and the job.

The learner checks each trajectory before it stores it and when it opens a dataset.  A value that is out of bounds would
make a fit diverge, and every later fit with it, so it is refused with the name of its array.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterator

import numpy as np

from icrl_dist.interfaces import Limits
from icrl_dist.stream.excerpts import show
from icrl_dist.stream.messages import is_name
from icrl_dist.types import NULL, Job, Spec, Trajectory

_ROUNDING = 1e-3
"""How far the sum of a label may be from 1, and a vector beyond its range: float32 rounds to about 1e-7."""


class Rejected(Exception):  # noqa: N818
    """A well-formed trajectory that this run cannot use."""

    def __init__(self, reason: str, detail: str) -> None:
        super().__init__(f"{reason}: {detail}")
        self.reason = reason


def check(trajectory: Trajectory, job: Job, spec: Spec, weights_digest: str, limits: Limits = Limits()) -> None:  # noqa: B008
    """Raises Rejected if the trajectory does not match its job, the spec or the weights of the job's policy version."""
    check_arrays(trajectory, job, spec, limits)
    identity = trajectory.identity
    if not is_name(trajectory.worker):
        raise Rejected("spec", f"{identity}: its worker's name {show(trajectory.worker)} is not one")
    if trajectory.variation != job.variation(identity):
        raise Rejected("unexpected", f"{identity}: its variation is not the one of its job")
    if (trajectory.policy_version, trajectory.weights_digest) != (job.policy_version, weights_digest):
        made = f"policy version {trajectory.policy_version} with weights {trajectory.weights_digest[:8]!r}"
        wanted = f"{job.policy_version} with weights {weights_digest[:8]!r}"
        raise Rejected("stale-weights", f"{identity}: made by {made}, its job names {wanted}")


def check_arrays(trajectory: Trajectory, job: Job, spec: Spec, limits: Limits) -> None:
    """Raises Rejected, with the name of the array, if a shape, a number of rows or a value is not possible in this job."""
    t, identity = trajectory, trajectory.identity
    size = (spec.horizon + 1, spec.observation)
    if t.observations.shape != size:
        raise Rejected("spec", f"{identity}: observations have shape {t.observations.shape}, this run needs {size}")
    if t.queries.shape[1] != spec.observation or t.labels.shape[1] != spec.actions:
        raise Rejected("spec", f"{identity}: queries have shape {t.queries.shape}, labels {t.labels.shape}")
    if (t.actions.ndim == 1) != spec.discrete:
        kind = "discrete" if spec.discrete else "continuous"
        raise Rejected("spec", f"{identity}: actions have shape {t.actions.shape}, this run has {kind} actions")
    if not spec.discrete and limits.disturbances is not None and t.adversary.shape[1] != limits.disturbances:
        raise Rejected(
            "spec", f"{identity}: adversary has shape {t.adversary.shape}, it needs {limits.disturbances} components"
        )
    for name, array, low, high in _ranges(t, spec, limits):
        if not _within(array, low, high):
            _refuse(trajectory, name, array, low, high)
    if spec.discrete and len(t.labels):
        sums = t.labels.sum(axis=1)
        row = int(abs(sums - 1).argmax())
        if abs(sums[row] - 1) > _ROUNDING:
            raise Rejected("spec", f"{identity}: labels[{row}] has the sum {sums[row]:g}; a distribution has the sum 1")
    wanted = job.payload.labels
    if wanted is not None:
        found = (len(t.queries), len(t.prev_actions), t.origin)
        for name, have, need in zip(("queries", "prev_actions", "origin"), found, wanted, strict=True):
            if have != need:
                raise Rejected("spec", f"{identity}: {name} = {have!r}, its job asks for {need!r}")


Bound = float | np.ndarray


@functools.lru_cache(maxsize=16)
def _observed(spec: Spec, slack: float) -> tuple[np.ndarray, np.ndarray]:
    """The smallest and the largest value of each observation component, in float32 as the observations."""
    low, high = np.array(spec.low), np.array(spec.high)
    beyond = slack * (high - low) + 1e-6 * np.maximum(abs(low), abs(high))
    return (low - beyond).astype(np.float32), (high + beyond).astype(np.float32)


def _ranges(t: Trajectory, spec: Spec, limits: Limits) -> Iterator[tuple[str, np.ndarray, Bound, Bound]]:
    """Every array with its smallest and its largest value, for all components or for each."""
    low, high = _observed(spec, limits.slack)
    first, last = (0, spec.actions - 1) if spec.discrete else (-1 - 1e-6, 1 + 1e-6)
    yield "observations", t.observations, low, high
    yield "queries", t.queries, low, high
    yield "actions", t.actions, first, last
    yield "prev_actions", t.prev_actions, first, last
    yield "rewards", t.rewards, *limits.reward
    yield "prev_rewards", t.prev_rewards, *limits.reward
    yield "labels", t.labels, *((0, 1 + _ROUNDING) if spec.discrete else (first, last))
    if spec.discrete:
        yield "adversary", t.adversary, -1, -1 if t.variation.adversary == NULL else spec.actions - 1
    else:
        most = limits.disturbance(t.variation.adversary)
        yield "adversary", t.adversary, -most, most


def _within(array: np.ndarray, low: Bound, high: Bound) -> bool:
    """Whether all values are within the bounds; a value that is not a number is not."""
    if isinstance(low, np.ndarray):
        return bool(((array >= low) & (array <= high)).all())
    return not len(array) or bool(array.min() >= low and array.max() <= high)


def _refuse(trajectory: Trajectory, name: str, array: np.ndarray, low: Bound, high: Bound) -> None:
    """Raises Rejected with the first value that is out of bounds."""
    lows, highs = np.broadcast_to(low, array.shape[1:]), np.broadcast_to(high, array.shape[1:])
    place = tuple(int(i) for i in np.argwhere(~((array >= lows) & (array <= highs)))[0])
    value, place_text = array[place], ", ".join(map(str, place))
    if not np.isfinite(value):
        raise Rejected("not-finite", f"{trajectory.identity}: {name}[{place_text}] is {value}, infinite or not a number")
    span = f"{lows[place[1:]]:g}..{highs[place[1:]]:g}"
    raise Rejected("spec", f"{trajectory.identity}: {name}[{place_text}] = {value:g} lies outside {span}")


def largest(trajectories: Iterator[Trajectory], spec: Spec, fits: Callable[[Trajectory], bool]) -> str:
    """The observation or reward that is largest relative to its range, as text with its trajectory; for a fit that diverged.

    ``fits``: which trajectories the fit uses.  Empty if there are none.
    """
    widest, found = -1.0, ""
    scale = np.maximum(1e-6, np.maximum(abs(np.array(spec.low)), abs(np.array(spec.high))))
    for one in filter(fits, trajectories):
        for name, array, unit in (("observations", one.observations, scale), ("rewards", one.rewards, 1.0)):
            size = float((abs(array) / unit).max())
            if not size <= widest:
                widest = size
                found = f"{one.identity}, whose {name} reach {float(abs(array).max()):g}"
    return found
