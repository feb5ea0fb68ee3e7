"""The weights that a worker acts with: exactly the version that its job names."""

from __future__ import annotations

import contextlib
import threading
import time

from torch import nn

from icrl_dist.models.weights import load_weights
from icrl_dist.stream import wire
from icrl_dist.stream.link import Link, Refused, StreamKeys, Unanswered
from icrl_dist.types import Weights

_KEPT = 4
"""Versions that a worker remembers: its job may name one that the learner is past."""


class WeightCache:
    """Keeps the learner's newest broadcasts; ``at`` waits for one policy version (Algorithm 3, line 12)."""

    def __init__(self, link: Link, keys: StreamKeys, model: nn.Module, limit: int, timeout_s: float = 60.0) -> None:
        self._link, self._keys, self._limit, self._timeout_s = link, keys, limit, timeout_s
        self._model = model.eval()
        self._loaded: Weights | None = None
        self._kept: dict[int, Weights] = {}
        self._arrived = threading.Condition()
        link.subscribe(keys.weights, self._hear)

    def _hear(self, key: str, payload: bytes) -> None:
        self._take(payload)

    def _take(self, payload: bytes) -> Weights:
        weights = wire.decode_weights(payload, self._limit)
        with self._arrived:
            weights = self._kept.setdefault(weights.version, weights)
            if len(self._kept) > _KEPT:
                del self._kept[next(iter(self._kept))]
            self._arrived.notify_all()
        return weights

    def at(self, version: int) -> tuple[nn.Module, str]:
        """The model of this version and its digest.

        Waits for the broadcast and asks the learner for it meanwhile.  Raises Unanswered if the
        version does not come in time, or if the learner is past it and has it no more.
        """
        deadline = time.monotonic() + self._timeout_s
        question = wire.encode_message("weights", version=version)
        while (weights := self._kept.get(version)) is None:
            newest = -1
            with contextlib.suppress(Refused, Unanswered):  # not there yet, or nobody there: what follows waits
                newest = self._take(self._link.request(self._keys.weights_latest, question, timeout_s=5.0)).version
            if newest > version:
                raise Unanswered(f"weights version {version} is gone; the learner is at {newest}")
            with self._arrived:
                self._arrived.wait_for(lambda: version in self._kept, timeout=0.2)
            if version not in self._kept and time.monotonic() > deadline:
                raise Unanswered(f"weights version {version} did not come within {self._timeout_s:g} s")
        if self._loaded is not weights:
            load_weights(self._model, weights.arrays)
            self._loaded = weights
        return self._model, weights.digest
