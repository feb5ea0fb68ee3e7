"""What the monitor plane says of trajectories: docs/tap.md."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from typing import Any

import numpy as np

from icrl_dist.stream import wire
from icrl_dist.stream.validation import WireError, as_list, as_map, from_array, text
from icrl_dist.types import Params, Trajectory

FRAMES = 100
"""States of an episode that the monitor plane shows, at most, besides the last."""

_COLUMNS = ("trials", "returns", "steps")


def trajectories(finished: Iterable[Trajectory], time: float) -> bytes:
    """What the monitor plane says of some trajectories of one worker: docs/tap.md.  ``time`` in Unix seconds."""
    told: dict[tuple[object, ...], dict[str, Any]] = {}
    worker = ""
    for one in finished:
        worker = one.worker
        of = (*one.identity[:4], one.policy_version, one.weights_digest)
        if of not in told:
            told[of] = {
                "identity": "/".join(map(str, one.identity[:4])),
                "problem": one.variation.task.kind,
                "task": _plain(one.variation.task.params),
                "adversary": {**_plain(one.variation.adversary.params), "kind": one.variation.adversary.kind},
                "policy_version": one.policy_version,
                "weights_digest": one.weights_digest,
                **{name: [] for name in _COLUMNS},
            }
        for name, value in zip(_COLUMNS, (one.identity.trial, one.episode_return, len(one.actions)), strict=True):
            told[of][name].append(value)
    return wire.encode_message("trajectories", worker=worker, time=float(time), variations=list(told.values()))


def rows(fields: Mapping[str, Any]) -> Iterator[dict[str, Any]]:
    """Each trajectory that the fields of such a message tell of, as a map of its own: what ``icrl-dist tap`` prints.

    Raises WireError for fields that are none of such a message.
    """
    for told in as_list(fields.get("variations"), "variations"):
        of = dict(as_map(told, "variations"))
        identity = text(of.pop("identity", None), "identity")
        columns = [as_list(of.pop(name, None), name) for name in _COLUMNS]
        if len({len(column) for column in columns}) != 1:
            raise WireError("shape", f"{_COLUMNS} have {[len(column) for column in columns]} entries, expected as many of each")
        for trial, earned, steps in zip(*columns, strict=True):
            one = {"identity": f"{identity}/{trial}", **of, "episode_return": earned, "steps": steps}
            yield {**one, "worker": fields.get("worker"), "time": fields.get("time")}


def episode(trajectory: Trajectory, time: float) -> bytes:
    """An episode to be drawn, of at most ``FRAMES`` states of it: docs/tap.md.  ``time`` in Unix seconds."""
    every = -(-len(trajectory.actions) // FRAMES)
    adversary = trajectory.adversary
    if adversary.ndim == 2:  # how hard it pushed
        adversary = np.linalg.norm(adversary, axis=1) / max(1, adversary.shape[1]) ** 0.5
    return wire.encode_message(
        "episode",
        identity=str(trajectory.identity),
        problem=trajectory.variation.task.kind,
        task=_plain(trajectory.variation.task.params),
        episode_return=trajectory.episode_return,
        every=every,
        observations=from_array(np.ascontiguousarray(trajectory.observations[::every])),
        adversary=from_array(adversary[::every].astype("<f4")),
        worker=trajectory.worker,
        time=float(time),
    )


def _plain(params: Params) -> dict[str, object]:
    return {name: list(value) if isinstance(value, tuple) else value for name, value in params}
