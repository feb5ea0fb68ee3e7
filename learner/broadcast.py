"""Weights out: a put for those present, a queryable for those who come later or repeat older work."""

from __future__ import annotations

import threading
from collections.abc import Callable

from icrl_dist.stream import wire
from icrl_dist.stream.link import Link, Query, StreamKeys
from icrl_dist.types import Weights


class Broadcast:
    """Publishes versions of T_theta and answers for them, older ones too.

    ``older`` fetches a version that was published before; it raises for one that there is not.
    """

    def __init__(self, link: Link, keys: StreamKeys, older: Callable[[int], Weights]) -> None:
        self._link, self._keys, self._older = link, keys, older
        self._lock = threading.Lock()
        self._newest = self._fetched = (-1, b"")
        self._digests: dict[int, str] = {-1: ""}
        link.serve(keys.weights_latest, self._answer)

    @property
    def version(self) -> int:
        """The newest version; -1 before the first."""
        return self._newest[0]

    def publish(self, weights: Weights) -> None:
        """Make this the newest version, for workers present and for latecomers."""
        payload = wire.encode_weights(weights)
        with self._lock:
            self._newest = weights.version, payload
            self._digests[weights.version] = weights.digest
        self._link.publish(self._keys.weights, payload, droppable=False)

    def digest_of(self, version: int) -> str:
        """Digest of a version; empty for -1, the policies without weights."""
        with self._lock:
            if version not in self._digests:
                self._digests[version] = self._older(version).digest
            return self._digests[version]

    def _answer(self, query: Query) -> None:
        """An empty request asks for the newest version, ``want`` for one by its number."""
        version = -1
        if query.payload:
            try:
                version = int(wire.decode_message(query.payload)[1]["version"])
            except (wire.WireError, KeyError, TypeError, ValueError) as error:
                query.refuse(f"schema: {error}")
                return
        with self._lock:
            newest, payload = self._newest
            if not payload or version > newest:
                query.refuse(f"busy: weights version {max(version, 0)} has not been published yet")
                return
            if 0 <= version < newest:
                if self._fetched[0] != version:
                    self._fetched = version, wire.encode_weights(self._older(version))
                payload = self._fetched[1]
        query.reply(payload)
