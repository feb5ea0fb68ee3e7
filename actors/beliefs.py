"""Publishes the belief of an in-context policy about its task; computes nothing without a subscriber."""

from __future__ import annotations

import logging
import time

from icrl_dist.interfaces import BeliefReader, Policy, Problem
from icrl_dist.stream import wire
from icrl_dist.stream.link import Link
from icrl_dist.types import Identity, Variation

_log = logging.getLogger(__name__)

PERIOD_S = 1.0
"""Shortest time between two messages, in seconds."""
SHARE = 1 / 200
"""Largest share of the worker's time that beliefs may take."""


class BeliefPublisher:
    """The ``look`` argument of ``collect.kinds.do``: reads the policy's belief and publishes it.

    It makes no random draws, does not change the policy and raises no errors, so trajectories have the same
    bytes with and without a subscriber.
    """

    def __init__(self, link: Link, key: str, worker: str, problem: Problem) -> None:
        """``key``: key of the messages on the monitor plane."""
        self._link, self._key, self._worker, self._problem = link, key, worker, problem
        self._next = 0.0
        self._reader: tuple[Variation, BeliefReader] | None = None

    def __call__(self, policy: Policy, row: int, identity: Identity, variation: Variation) -> None:
        """Publish the belief of environment ``row``, if there is a subscriber and the limits above allow it."""
        now = time.monotonic()
        if now < self._next or self._problem.belief is None:
            return
        began = time.thread_time()
        try:
            if self._link.has_subscribers(self._key):
                self._link.publish(self._key, self._message(policy, row, identity, variation), droppable=True)
        except Exception as error:
            _log.warning("a belief could not be published: %s", error)
        self._next = now + max(PERIOD_S, (time.thread_time() - began) / SHARE)

    def _message(self, policy: Policy, row: int, identity: Identity, variation: Variation) -> bytes:
        assert self._problem.belief is not None
        if self._reader is None or self._reader[0] != variation:
            self._reader = variation, self._problem.belief(variation)
        fields = self._reader[1].message(policy, row)
        return wire.encode_message("belief", identity=str(identity), worker=self._worker, time=time.time(), **fields)
