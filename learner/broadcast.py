"""Broadcast of weights: a put for the workers that are connected, and a queryable for later or older requests."""

from __future__ import annotations

import threading
from collections.abc import Callable

from icrl_dist.stream import wire
from icrl_dist.stream.link import LOST, Link, Query, StreamKeys
from icrl_dist.stream.validation import integer
from icrl_dist.types import Weights


class Broadcast:
    """Publishes policy versions of T_theta and answers requests for them, also for older ones.

    ``older`` loads a version that was published before; if it raises an error, the run must end.
    """

    def __init__(self, link: Link, keys: StreamKeys, older: Callable[[int], Weights]) -> None:
        self._link, self._keys, self._older = link, keys, older
        self._lock = threading.Lock()
        self._newest = self._loaded = (-1, b"")
        self._digests: dict[int, str] = {-1: ""}
        link.serve(keys.weights_latest, self._answer)

    @property
    def version(self) -> int:
        """The newest policy version; -1 before the first."""
        return self._newest[0]

    def publish(self, weights: Weights) -> None:
        """Make this the newest version, for connected workers and for later requests."""
        payload = wire.encode_weights(weights)
        with self._lock:
            self._newest = weights.version, payload
            self._digests[weights.version] = weights.digest
        self._link.publish(self._keys.weights, payload, droppable=False)

    def digest_of(self, version: int) -> str:
        """The weights digest of a version; empty for -1, the policies without weights."""
        with self._lock:
            if version not in self._digests:
                self._digests[version] = self._older(version).digest
            return self._digests[version]

    def _answer(self, query: Query) -> None:
        """Answer an empty request with the newest version, a request with ``version`` with that one."""
        version = -1
        if query.payload:
            try:
                version = integer(wire.decode_message(query.payload)[1].get("version"), "version", -1)
            except wire.WireError as error:
                query.refuse(f"schema: {error.detail}")
                return
        with self._lock:
            newest, payload = self._newest
            if not payload or version > newest:
                query.refuse(f"busy: policy version {max(version, 0)} is not published yet; ask again")
                return
            if 0 <= version < newest:
                if self._loaded[0] != version:
                    try:
                        self._loaded = version, wire.encode_weights(self._older(version))
                    except Exception as error:  # ``older`` has ended the run
                        query.refuse(f"{LOST}: {error}")
                        return
                payload = self._loaded[1]
        query.reply(payload)
