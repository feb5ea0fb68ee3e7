"""Publishes what an in-context policy believes of its task; without a subscriber nothing is computed."""

from __future__ import annotations

import logging
import time

from icrl_dist.interfaces import BeliefReader, Policy, Problem
from icrl_dist.stream import wire
from icrl_dist.stream.link import Link
from icrl_dist.types import Identity, Variation

_log = logging.getLogger(__name__)

PERIOD_S = 1.0
"""At most so often, and"""
SHARE = 1 / 200
"""never more than this share of the worker's time."""


class BeliefPublisher:
    """The ``look`` of ``collect.kinds.do``: reads a policy's belief and publishes it.

    It draws nothing, changes nothing of the policy, and raises nothing, so trajectories are the same,
    byte for byte, with and without a subscriber.
    """

    def __init__(self, link: Link, key: str, worker: str, problem: Problem) -> None:
        """``key``: where on the monitor plane."""
        self._link, self._key, self._worker, self._problem = link, key, worker, problem
        self._at = 0.0
        self._reader: tuple[Variation, BeliefReader] | None = None

    def __call__(self, policy: Policy, row: int, identity: Identity, variation: Variation) -> None:
        """Publish the belief of environment ``row`` if there is a subscriber, and not too often."""
        now = time.monotonic()
        if now < self._at or self._problem.belief is None:
            return
        spent = time.thread_time()
        try:
            if self._link.has_subscribers(self._key):
                self._link.publish(self._key, self._message(policy, row, identity, variation), droppable=True)
        except Exception as error:
            _log.warning("a belief is lost: %s", error)
        self._at = now + max(PERIOD_S, (time.thread_time() - spent) / SHARE)

    def _message(self, policy: Policy, row: int, identity: Identity, variation: Variation) -> bytes:
        assert self._problem.belief is not None
        if self._reader is None or self._reader[0] != variation:
            self._reader = variation, self._problem.belief(variation)
        fields = self._reader[1].message(policy, row)
        return wire.encode_message("belief", identity=str(identity), worker=self._worker, time=time.time(), **fields)
