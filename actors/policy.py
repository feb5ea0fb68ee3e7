"""The weights that a worker acts with: exactly the version that its job names."""

from __future__ import annotations

import threading
import time

from icrl_dist.config import ModelConfig
from icrl_dist.models.dpt import PretrainedTransformer, load_weights
from icrl_dist.stream import wire
from icrl_dist.stream.link import Keys, Link, Refused, Unanswered
from icrl_dist.types import Spec, Weights


class LivePolicy:
    """Follows the learner's broadcasts; ``at`` waits for one version (Algorithm 3, line 12)."""

    def __init__(self, link: Link, keys: Keys, spec: Spec, config: ModelConfig, limit: int, timeout_s: float = 60.0) -> None:
        self._link, self._keys, self._limit, self._timeout_s = link, keys, limit, timeout_s
        self._model = PretrainedTransformer(spec, config).eval()
        self._loaded: Weights | None = None
        self._newest: Weights | None = None
        self._arrived = threading.Condition()
        link.subscribe(keys.weights, lambda _, payload: self._take(payload))

    def _take(self, payload: bytes) -> None:
        weights = wire.decode_weights(payload, self._limit)
        with self._arrived:
            if self._newest is None or weights.version > self._newest.version:
                self._newest = weights
                self._arrived.notify_all()

    def at(self, version: int) -> tuple[PretrainedTransformer, str]:
        """The model of this version and its digest.

        Waits for the broadcast and asks for the latest meanwhile.  Raises Unanswered if the
        version does not come in time, or if the learner is past it.
        """
        deadline = time.monotonic() + self._timeout_s
        while self._newest is None or self._newest.version < version:
            try:
                self._take(self._link.request(self._keys.weights_latest, b"", timeout_s=5.0))
            except (Refused, Unanswered):
                with self._arrived:
                    self._arrived.wait(0.2)
            if time.monotonic() > deadline:
                raise Unanswered(f"weights version {version} did not come within {self._timeout_s:g} s")
        newest = self._newest
        if newest.version != version:
            raise Unanswered(f"weights version {version} is gone; the learner is at {newest.version}")
        if self._loaded is not newest:
            load_weights(self._model, newest.arrays)
            self._loaded = newest
        return self._model, newest.digest
