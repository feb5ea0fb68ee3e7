"""Several items in one request, with one answer for each.

A request wakes both processes, which costs a few hundred microseconds whatever it holds; so
items that are ready at the same time share a request.
"""

from __future__ import annotations

import threading
from collections.abc import Sequence
from dataclasses import dataclass

from icrl_dist.stream.link import Query
from icrl_dist.stream.validation import WireError, pack, read, unpack

_ANSWERS_BYTES = 1 << 20


@dataclass(frozen=True, slots=True)
class _Request:
    v: int
    kind: str
    items: tuple[bytes, ...]


@dataclass(frozen=True, slots=True)
class _Answers:
    v: int
    kind: str
    reasons: tuple[str, ...]


def join(items: Sequence[bytes]) -> bytes:
    """Items as one request."""
    return pack("batch", {"items": list(items)})


def split(query: Query, limit: int) -> list[Query]:
    """The items of a request, each as a query; the request is answered when all of them are.

    Raises WireError if the request is not a batch, or is longer than ``limit`` bytes.
    """
    items = read(_Request, unpack(query.payload, limit), "batch").items
    if not items:
        query.reply(pack("answers", {"reasons": []}))
    request = _SharedRequest(query, len(items))
    return [_ItemQuery(request, place, item) for place, item in enumerate(items)]


def reasons(answer: bytes, count: int) -> list[str]:
    """Why each of ``count`` items was refused; an empty text for an accepted item.

    Raises WireError if the answer does not have ``count`` reasons.
    """
    found = read(_Answers, unpack(answer, _ANSWERS_BYTES), "answers").reasons
    if len(found) != count:
        raise WireError("schema", f"answers has {len(found)} reasons, expected {count}")
    return list(found)


class _SharedRequest:
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


class _ItemQuery:
    def __init__(self, request: _SharedRequest, place: int, payload: bytes) -> None:
        self._request, self._place = request, place
        self.payload = payload

    @property
    def key(self) -> str:
        return self._request.query.key

    def reply(self, payload: bytes) -> None:
        self._request.settle(self._place, "")

    def refuse(self, reason: str) -> None:
        self._request.settle(self._place, reason or "refused")
