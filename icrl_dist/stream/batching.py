"""Several items in one request, each answered for itself.

A request costs the two processes a few hundred microseconds of waking each other up, whatever
it holds; so what is ready together travels together.
"""

from __future__ import annotations

import threading
from collections.abc import Sequence

from icrl_dist.stream.link import Query
from icrl_dist.stream.validation import as_list, exactly, pack, text, typed, unpack


def join(items: Sequence[bytes]) -> bytes:
    """Items as one request."""
    return pack("batch", {"items": list(items)})


def split(query: Query, limit: int) -> list[Query]:
    """The items of a request as queries of their own; the request is answered when they all are.

    Raises WireError if the request is not a batch, or is longer than ``limit`` bytes.
    """
    fields = exactly(unpack(query.payload, limit), "batch", {"v", "kind", "items"})
    items = [typed(item, bytes, "item") for item in as_list(fields["items"], "items")]
    if not items:
        query.reply(pack("answers", {"reasons": []}))
    whole = _Whole(query, len(items))
    return [_Part(whole, place, item) for place, item in enumerate(items)]


def reasons(answer: bytes, count: int) -> list[str]:
    """Why each of ``count`` items was refused; empty for those that were taken.

    Raises WireError if the answer is not one to so many items.
    """
    fields = exactly(unpack(answer, 1 << 20), "answers", {"v", "kind", "reasons"})
    return [text(reason, "reason") for reason in as_list(fields["reasons"], "reasons", count)]


class _Whole:
    def __init__(self, query: Query, count: int) -> None:
        self.query = query
        self._lock = threading.Lock()
        self._reasons: list[str | None] = [None] * count
        self._left = count

    def settle(self, place: int, reason: str) -> None:
        with self._lock:
            if self._reasons[place] is not None:
                raise RuntimeError(f"item {place} of a request on {self.query.key} was answered before")
            self._reasons[place] = reason
            self._left -= 1
            done = not self._left
        if done:
            self.query.reply(pack("answers", {"reasons": self._reasons}))


class _Part:
    def __init__(self, whole: _Whole, place: int, payload: bytes) -> None:
        self._whole, self._place = whole, place
        self.payload = payload

    @property
    def key(self) -> str:
        return self._whole.query.key

    def reply(self, payload: bytes) -> None:
        self._whole.settle(self._place, "")

    def refuse(self, reason: str) -> None:
        self._whole.settle(self._place, reason or "refused")
