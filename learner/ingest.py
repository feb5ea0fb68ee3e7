"""Ingest: decodes and checks untrusted bytes, stores the trajectories, and counts every drop by its reason.

Zenoh's thread only puts a query into a bounded queue.  One thread takes groups out of it,
checks them, appends them with one fsync, and only then replies: after a reply the trajectory
survives any crash.  (A second thread that checks one group during the fsync of another was
slower: the two threads compete for the interpreter lock.)
"""

from __future__ import annotations

import logging
import queue
import threading
from collections import Counter
from collections.abc import Callable, Sequence

from icrl_dist.collect.checks import Rejected, check
from icrl_dist.interfaces import Limits
from icrl_dist.storage.dataset import Dataset
from icrl_dist.stream import batching, wire
from icrl_dist.stream.link import Query
from icrl_dist.types import Identity, Job, Spec, Trajectory

_log = logging.getLogger(__name__)

REASONS = (*wire.REASONS, "spec", "not-finite", "unexpected", "stale-weights", "duplicate", "busy")
"""Why a message was not stored.  A ``duplicate`` is acknowledged; the others are refused."""


class Ingest:
    """Stores trajectories on its own thread."""

    def __init__(
        self,
        store: Dataset,
        spec: Spec,
        limit: int,
        pending_job: Callable[[Identity], Job | None],
        digest_of: Callable[[int], str],
        stored: Callable[[Trajectory], None],
        failed: Callable[[BaseException], None],
        limits: Limits = Limits(),  # noqa: B008
        capacity: int = 256,
        capacity_bytes: int = 64 << 20,
    ) -> None:
        """``limit``: the largest message in bytes; ``limits``: the values that trajectories can have.

        ``pending_job`` returns the job in which a trajectory is missing, None if no job needs it.
        ``digest_of`` returns the weights digest of a policy version.  ``stored`` is called after a
        trajectory is stored, ``failed`` when the ingest cannot continue.  At most ``capacity`` messages
        of together ``capacity_bytes`` are queued (one always fits); a further one is answered ``busy``.
        """
        self.drops: Counter[str] = Counter()
        self.commits = 0
        """Number of groups stored, with one fsync each."""
        self._store, self._spec, self._limit, self._limits = store, spec, limit, limits
        self._pending_job, self._digest_of, self._stored, self._failed = pending_job, digest_of, stored, failed
        self._load = _QueueLoad(capacity, capacity_bytes)
        self._queue: queue.SimpleQueue[Query | None] = queue.SimpleQueue()
        self._thread = threading.Thread(target=self._run, name="ingest", daemon=True)
        self._thread.start()

    def put(self, query: Query) -> None:
        """Queue a request without blocking; what does not fit is answered ``busy``, and the worker sends it again."""
        try:
            trajectories = batching.split(query, self._limit)
        except wire.WireError as error:
            self._refuse(query, error)
            return
        for one in trajectories:
            if self._load.add(len(one.payload)):
                self._queue.put(one)
            else:
                self.drops["busy"] += 1
                one.refuse("busy")

    def _refuse(self, query: Query, error: wire.WireError | Rejected) -> None:
        self.drops[error.reason] += 1
        _log.warning("refused a message: %s", str(error))  # the error itself would keep the message
        query.refuse(str(error))

    def close(self) -> None:
        """Dataset what is queued, then stop the thread."""
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
            except Exception as error:  # the run ends; workers send unanswered messages again to the next learner
                _log.exception("the ingest cannot continue")
                self._failed(error)
                return
            self._load.remove(group)

    def _next(self) -> Query | None:
        """The next queued query; None if the queue is empty or the ingest is closing."""
        try:
            found = self._queue.get_nowait()
        except queue.Empty:
            return None
        if found is None:
            self._queue.put(None)  # the loop in _run reads it next
        return found

    def take(self, group: list[Query]) -> None:
        """Check a group of messages, refuse the bad ones, store the good ones, then acknowledge these.

        Raises StoreError if they cannot be stored; then none of them is acknowledged.
        """
        good: dict[Identity, Trajectory] = {}
        acknowledged: list[Query] = []
        for query in group:
            try:
                trajectory = wire.decode_trajectory(query.payload, self._limit)
                identity = trajectory.identity
                job = self._pending_job(identity)
                if identity in self._store or identity in good:
                    self.drops["duplicate"] += 1
                elif job is None:
                    raise Rejected("unexpected", f"{identity}: no open job contains it")
                else:
                    check(trajectory, job, self._spec, self._digest_of(job.policy_version), self._limits)
                    good[identity] = trajectory
            except (wire.WireError, Rejected) as error:
                self._refuse(query, error)
            else:
                acknowledged.append(query)
        if good:
            self._store.append(list(good.values()))
            self.commits += 1
        for trajectory in good.values():
            self._stored(trajectory)
        for query in acknowledged:
            query.reply(b"stored")


class _QueueLoad:
    """Number and total size of the messages that are queued or being stored, with an upper bound for each."""

    def __init__(self, count: int, size: int) -> None:
        self._lock = threading.Lock()
        self._count = self._size = 0
        self._bounds = (count, size)

    def add(self, size: int) -> bool:
        """Add a message of ``size`` bytes if it fits; returns whether it did."""
        with self._lock:
            count, total = self._bounds
            if self._count and (self._count >= count or self._size + size > total):
                return False
            self._count += 1
            self._size += size
            return True

    def remove(self, group: Sequence[Query]) -> None:
        """Remove messages that are answered."""
        with self._lock:
            self._count -= len(group)
            self._size -= sum(len(query.payload) for query in group)
