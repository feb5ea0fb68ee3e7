"""What T_theta believes while it acts in a job, for whoever looks on; nobody looks, nothing is computed."""

from __future__ import annotations

import logging
import time

from icrl_dist.config.run import Run
from icrl_dist.problems.darkroom.posterior import Room
from icrl_dist.rollout.deployment import InContextPolicy
from icrl_dist.stream import wire
from icrl_dist.stream.link import Link
from icrl_dist.types import NULL, Identity, Variation

_log = logging.getLogger(__name__)

PERIOD_S = 1.0
"""At most so often, and"""
SHARE = 1 / 200
"""never more than this share of the worker's time."""


class Beliefs:
    """Hand it to ``jobs.do``: it reads a policy and publishes what it read.

    It draws nothing, changes nothing of the policy, and raises nothing: a trajectory is the same,
    byte for byte, whoever looks on.
    """

    def __init__(self, link: Link, key: str, worker: str, run: Run) -> None:
        """``key``: where on the monitor plane."""
        self._link, self._key, self._worker, self._run = link, key, worker, run
        self._at = 0.0
        self._room: tuple[Variation, Room] | None = None

    def __call__(self, policy: InContextPolicy, row: int, identity: Identity, variation: Variation) -> None:
        """Publish the belief of environment ``row``, if it is a Dark Room, somebody looks on, and it is time."""
        now = time.monotonic()
        if now < self._at or variation.task.kind != "darkroom":
            return
        spent = time.thread_time()
        try:
            if self._link.has_subscribers(self._key):
                self._link.publish(self._key, self._message(policy, row, identity, variation), droppable=True)
        except Exception as error:
            _log.warning("a belief is lost: %s", error)
        self._at = now + max(PERIOD_S, (time.thread_time() - spent) / SHARE)

    def _message(self, policy: InContextPolicy, row: int, identity: Identity, variation: Variation) -> bytes:
        room, task = self._run.darkroom, variation.task
        if self._room is None or self._room[0] != variation:
            supposed = list(dict.fromkeys((NULL, variation.adversary)))
            made = Room(int(task.number("size")), int(task.number("horizon")), supposed, room.gamma, room.label_slack)
            self._room = variation, made
        belief = self._room[1].read(policy, row)
        x, y = task.vector("goal")
        return wire.encode_message(
            "belief",
            identity=str(identity),
            worker=self._worker,
            size=int(task.number("size")),
            goal=[int(x), int(y)],
            implied=[round(float(p), 6) for p in belief.implied],
            exact=[round(float(p), 6) for p in belief.exact],
            divergence=belief.divergence,
            transitions=belief.transitions,
            time=time.time(),
        )
