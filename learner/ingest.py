"""The inbox: from untrusted bytes to stored trajectories, every drop counted by reason.

Zenoh's thread only puts a query into a bounded queue.  One thread takes whole groups out,
checks them, appends them with one fsync, and only then replies: a reply is the promise that
the trajectory will be there after any crash.  (Checking one group on a second thread while
another waits for its fsync was slower: the threads wait for each other's interpreter lock.)
"""

from __future__ import annotations

import logging
import queue
import threading
from collections import Counter
from collections.abc import Callable, Sequence

import numpy as np

from icrl_dist.storage.dataset import Dataset
from icrl_dist.stream import batching, wire
from icrl_dist.stream.link import Query
from icrl_dist.types import Identity, Job, Spec, Trajectory

_log = logging.getLogger(__name__)

REASONS = (*wire.REASONS, "spec", "not-finite", "unexpected", "stale-weights", "duplicate", "busy")
"""Why a message was not stored.  ``duplicate`` is acknowledged, the others are refused."""


class Rejected(Exception):  # noqa: N818
    """A well-formed trajectory that this run cannot use."""

    def __init__(self, reason: str, detail: str) -> None:
        super().__init__(f"{reason}: {detail}")
        self.reason = reason


def check(trajectory: Trajectory, job: Job, spec: Spec, digest: str) -> None:
    """Raises Rejected unless the trajectory is what its job asked for."""
    identity, size = trajectory.identity, (spec.horizon + 1, spec.observation)
    if trajectory.observations.shape != size:
        raise Rejected("spec", f"{identity}: observations {trajectory.observations.shape}, this run needs {size}")
    if trajectory.queries.shape[1] != spec.observation or trajectory.labels.shape[1] != spec.actions:
        raise Rejected("spec", f"{identity}: queries {trajectory.queries.shape}, labels {trajectory.labels.shape}")
    if (trajectory.actions.ndim == 1) != spec.discrete:
        raise Rejected("spec", f"{identity}: actions {trajectory.actions.shape} are of the other kind than this run's")
    low, high = (0, spec.actions - 1) if spec.discrete else (-1, 1)
    for chosen in (trajectory.actions, trajectory.taken, *(() if spec.discrete else (trajectory.labels,))):
        if len(chosen) and (chosen.min() < low or chosen.max() > high):
            raise Rejected("spec", f"{identity}: an action lies outside {low}..{high}")
    if not all(map(_finite, trajectory.arrays().values())):
        raise Rejected("not-finite", f"{identity}: a value is infinite or not a number")
    if trajectory.variation != job.variation(identity):
        raise Rejected("unexpected", f"{identity}: comes from another variation than its job's")
    if (trajectory.policy_version, trajectory.weights_digest) != (job.policy_version, digest):
        raise Rejected(
            "stale-weights", f"{identity}: weights {trajectory.policy_version} acted, the job names {job.policy_version}"
        )


def _finite(array: np.ndarray) -> bool:
    """Whether every value is; a sum of squares that is finite, the quick way, says so too."""
    return bool(np.isfinite(np.vdot(array, array)) or np.isfinite(array).all())


class Inbox:
    """Takes trajectories in on its own thread; ``wants`` and ``stored`` are the Board's."""

    def __init__(
        self,
        store: Dataset,
        spec: Spec,
        limit: int,
        wants: Callable[[Identity], Job | None],
        digest_of: Callable[[int], str],
        stored: Callable[[Trajectory], None],
        failed: Callable[[BaseException], None],
        capacity: int = 256,
        capacity_bytes: int = 64 << 20,
    ) -> None:
        """What comes beyond ``capacity`` messages, or ``capacity_bytes`` of them, is answered ``busy``; one always fits."""
        self.drops: Counter[str] = Counter()
        self.commits = 0
        """Groups stored, an fsync each."""
        self._store, self._spec, self._limit = store, spec, limit
        self._wants, self._digest_of, self._stored, self._failed = wants, digest_of, stored, failed
        self._room = _Room(capacity, capacity_bytes)
        self._queue: queue.SimpleQueue[Query | None] = queue.SimpleQueue()
        self._thread = threading.Thread(target=self._run, name="inbox", daemon=True)
        self._thread.start()

    def put(self, query: Query) -> None:
        """Accept a request without ever blocking; a full inbox answers ``busy``: send it again."""
        try:
            trajectories = batching.split(query, self._limit)
        except wire.WireError as error:
            self._refuse(query, error)
            return
        for one in trajectories:
            if self._room.enter(len(one.payload)):
                self._queue.put(one)
            else:
                self.drops["busy"] += 1
                one.refuse("busy")

    def _refuse(self, query: Query, error: wire.WireError | Rejected) -> None:
        self.drops[error.reason] += 1
        _log.warning("refused a message: %s", error)
        query.refuse(str(error))

    def close(self) -> None:
        """Take in what is queued, then stop."""
        self._queue.put(None)
        self._thread.join()

    def _run(self) -> None:
        while (first := self._queue.get()) is not None:
            group, following = [first], self._next()
            while following is not None:
                group.append(following)
                following = self._next()
            try:
                self.take(group)
            except Exception as error:  # the run ends; unanswered, what was sent will be sent again
                _log.exception("the inbox cannot go on")
                self._failed(error)
                return
            self._room.leave(group)

    def _next(self) -> Query | None:
        """What waits next; None if nothing does, or if the inbox is closing."""
        try:
            found = self._queue.get_nowait()
        except queue.Empty:
            return None
        if found is None:
            self._queue.put(None)  # for the next time around
        return found

    def take(self, group: list[Query]) -> None:
        """Check a group of messages, refuse the bad ones, store the good ones, then acknowledge those.

        Raises StoreError if they could not be stored; none of them is acknowledged then.
        """
        good: dict[Identity, Trajectory] = {}
        taken: list[Query] = []
        for query in group:
            try:
                trajectory = wire.decode_trajectory(query.payload, self._limit)
                identity = trajectory.identity
                job = self._wants(identity)
                if identity in self._store or identity in good:
                    self.drops["duplicate"] += 1
                elif job is None:
                    raise Rejected("unexpected", f"{identity}: nobody asked for it")
                else:
                    check(trajectory, job, self._spec, self._digest_of(job.policy_version))
                    good[identity] = trajectory
            except (wire.WireError, Rejected) as error:
                self._refuse(query, error)
            else:
                taken.append(query)
        if good:
            self._store.append(list(good.values()))
            self.commits += 1
        for trajectory in good.values():
            self._stored(trajectory)
        for query in taken:
            query.reply(b"stored")


class _Room:
    """Messages taken in and not yet done with: so many, of so many bytes together."""

    def __init__(self, count: int, size: int) -> None:
        self._lock = threading.Lock()
        self._count = self._size = 0
        self._most = (count, size)

    def enter(self, size: int) -> bool:
        """Whether there was room for a message of this size, which is now in."""
        with self._lock:
            count, total = self._most
            if self._count and (self._count >= count or self._size + size > total):
                return False
            self._count += 1
            self._size += size
            return True

    def leave(self, group: Sequence[Query]) -> None:
        """These are done with."""
        with self._lock:
            self._count -= len(group)
            self._size -= sum(len(query.payload) for query in group)
