"""Weights out: a put for those present, a queryable for those who come later."""

from __future__ import annotations

import threading

from icrl_dist.stream import wire
from icrl_dist.stream.link import Keys, Link, Query
from icrl_dist.types import Weights


class Broadcast:
    """Publishes versions of T_theta and remembers the newest."""

    def __init__(self, link: Link, keys: Keys) -> None:
        self._link, self._keys = link, keys
        self._lock = threading.Lock()
        self._latest = b""
        self.version = -1
        self._digests: dict[int, str] = {}
        link.serve(keys.weights_latest, self._answer)

    def publish(self, weights: Weights) -> None:
        """Make this the newest version, for workers present and for latecomers."""
        payload = wire.encode_weights(weights)
        with self._lock:
            self._latest, self.version = payload, weights.version
            self._digests[weights.version] = weights.digest
        self._link.publish(self._keys.weights, payload, droppable=False)

    def digest_of(self, version: int) -> str:
        """Digest of a published version; empty for -1, the policies without weights."""
        with self._lock:
            return self._digests.get(version, "")

    def _answer(self, query: Query) -> None:
        with self._lock:
            latest = self._latest
        if latest:
            query.reply(latest)
        else:
            query.refuse("busy: no weights have been published yet")
