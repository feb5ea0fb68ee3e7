"""The messages about trajectories on the monitor plane; docs/tap.md describes them."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from typing import Any

import numpy as np

from icrl_dist.stream import wire
from icrl_dist.stream.validation import WireError, as_list, as_map, from_array, text
from icrl_dist.types import Params, Trajectory

FRAMES = 100
"""At most this many states of an episode are published, besides the last."""

_COLUMNS = ("trials", "returns", "steps")


def trajectories(finished: Iterable[Trajectory], time: float) -> bytes:
    """The message ``trajectories`` about trajectories of one worker, grouped by variation.  ``time`` in Unix seconds."""
    groups: dict[tuple[object, ...], dict[str, Any]] = {}
    worker = ""
    for one in finished:
        worker = one.worker
        group = (*one.identity[:4], one.policy_version, one.weights_digest)
        if group not in groups:
            groups[group] = {
                "identity": "/".join(map(str, one.identity[:4])),
                "problem": one.variation.task.kind,
                "task": _as_map(one.variation.task.params),
                "adversary": {**_as_map(one.variation.adversary.params), "kind": one.variation.adversary.kind},
                "policy_version": one.policy_version,
                "weights_digest": one.weights_digest,
                **{name: [] for name in _COLUMNS},
            }
        for name, value in zip(_COLUMNS, (one.identity.trial, one.episode_return, len(one.actions)), strict=True):
            groups[group][name].append(value)
    return wire.encode_message("trajectories", worker=worker, time=float(time), variations=list(groups.values()))


def rows(fields: Mapping[str, Any]) -> Iterator[dict[str, Any]]:
    """The trajectories of a message ``trajectories``, a map each, as ``icrl-dist tap`` prints them.

    Raises WireError if the fields are not those of such a message.
    """
    for variation in as_list(fields.get("variations"), "variations"):
        shared = dict(as_map(variation, "variations"))
        identity = text(shared.pop("identity", None), "identity")
        columns = [as_list(shared.pop(name, None), name) for name in _COLUMNS]
        if len({len(column) for column in columns}) != 1:
            raise WireError("shape", f"{_COLUMNS} have {[len(column) for column in columns]} entries, expected as many of each")
        for trial, episode_return, steps in zip(*columns, strict=True):
            one = {"identity": f"{identity}/{trial}", **shared, "episode_return": episode_return, "steps": steps}
            yield {**one, "worker": fields.get("worker"), "time": fields.get("time")}


def episode(trajectory: Trajectory, time: float) -> bytes:
    """The message ``episode``: at most ``FRAMES`` evenly spaced states of an episode.  ``time`` in Unix seconds."""
    every = -(-len(trajectory.actions) // FRAMES)
    adversary = trajectory.adversary
    if adversary.ndim == 2:  # the size of the adversary's action, 1 at most
        adversary = np.linalg.norm(adversary, axis=1) / max(1, adversary.shape[1]) ** 0.5
    return wire.encode_message(
        "episode",
        identity=str(trajectory.identity),
        problem=trajectory.variation.task.kind,
        task=_as_map(trajectory.variation.task.params),
        episode_return=trajectory.episode_return,
        every=every,
        observations=from_array(np.ascontiguousarray(trajectory.observations[::every])),
        adversary=from_array(adversary[::every].astype("<f4")),
        worker=trajectory.worker,
        time=float(time),
    )


def _as_map(params: Params) -> dict[str, object]:
    return {name: list(value) if isinstance(value, tuple) else value for name, value in params}
