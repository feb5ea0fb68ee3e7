"""The weights of a worker's policy: exactly the version that its job names."""

from __future__ import annotations

import threading
import time

from torch import nn

from icrl_dist.models.weights import load_weights
from icrl_dist.stream import wire
from icrl_dist.stream.link import LOST, Link, Refused, StreamKeys, Unanswered
from icrl_dist.types import Weights

_VERSIONS = 4
"""Number of versions in the cache: a job may name an older one than the learner's newest."""


class WeightCache:
    """Caches the newest policy versions that the learner published; ``at`` waits for one (Algorithm 3, line 12)."""

    def __init__(self, link: Link, keys: StreamKeys, model: nn.Module, limit: int, timeout_s: float = 60.0) -> None:
        self._link, self._keys, self._limit, self._timeout_s = link, keys, limit, timeout_s
        self._model = model.eval()
        self._loaded: Weights | None = None
        self._cached: dict[int, Weights] = {}
        self._arrived = threading.Condition()
        link.subscribe(keys.weights, self._on_broadcast)

    def _on_broadcast(self, key: str, payload: bytes) -> None:
        self._add(payload)

    def _add(self, payload: bytes) -> Weights:
        weights = wire.decode_weights(payload, self._limit)
        with self._arrived:
            weights = self._cached.setdefault(weights.version, weights)
            if len(self._cached) > _VERSIONS:
                del self._cached[next(iter(self._cached))]
            self._arrived.notify_all()
        return weights

    def at(self, version: int) -> tuple[nn.Module, str]:
        """The model of this version and its weights digest.

        Waits for the broadcast, and repeatedly requests the version from the learner.  Raises Unanswered if it
        does not arrive in time, or if the learner has lost it or has only newer versions.
        """
        deadline = time.monotonic() + self._timeout_s
        request = wire.encode_message("weights", version=version)
        while (weights := self._cached.get(version)) is None:
            newest = -1
            try:
                newest = self._add(self._link.request(self._keys.weights_latest, request, timeout_s=5.0)).version
            except Refused as error:
                if LOST in str(error):
                    raise Unanswered(f"weights version {version}: {error}") from None
            except Unanswered:  # no learner: wait below
                pass
            if newest > version:
                raise Unanswered(f"weights version {version} is gone; the learner is at {newest}")
            with self._arrived:
                self._arrived.wait_for(lambda: version in self._cached, timeout=0.2)
            if version not in self._cached and time.monotonic() > deadline:
                raise Unanswered(f"weights version {version} did not come within {self._timeout_s:g} s")
        if self._loaded is not weights:
            load_weights(self._model, weights.arrays)
            self._loaded = weights
        return self._model, weights.digest
