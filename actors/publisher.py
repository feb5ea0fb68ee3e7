"""What a worker shows of its trajectories to whoever looks on: a line of each, and some of them whole."""

from __future__ import annotations

import threading
import time

from icrl_dist.stream import monitor_messages
from icrl_dist.stream.link import Link, StreamKeys
from icrl_dist.types import Identity, Trajectory

PERIOD_S = 0.1
"""What is told of trajectories goes out at most so often: a message costs what a hundred lines in it do."""
_MOST = 256
"""Trajectories a message."""


class Showing:
    """Publishes on the monitor plane; safe to use from several threads."""

    def __init__(self, link: Link, keys: StreamKeys, worker: str) -> None:
        self._link, self._lock = link, threading.Lock()
        self._lines, self._whole = keys.monitor(f"trajectories/{worker}"), keys.monitor(f"episode/{worker}")
        self._waiting: list[Trajectory] = []
        self._sent = float("-inf")
        self._samples = Samples()

    def show(self, trajectory: Trajectory) -> None:
        """Tell of a trajectory, now or with those that follow within ``PERIOD_S``.

        Whoever shows the last for a while calls ``flush``.  Raises LinkError if the link is closed.
        """
        now = time.monotonic()
        with self._lock:
            self._waiting.append(trajectory)
            if now - self._sent >= PERIOD_S or len(self._waiting) >= _MOST:
                self._send(now)
            whole = self._samples.take(trajectory.identity, now)
        if whole:
            self._link.publish(self._whole, monitor_messages.episode(trajectory, time.time()), droppable=True)

    def flush(self) -> None:
        """Tell of those that wait.  Raises LinkError if the link is closed."""
        with self._lock:
            if self._waiting:
                self._send(time.monotonic())

    def _send(self, now: float) -> None:
        waiting, self._waiting, self._sent = self._waiting, [], now
        self._link.publish(self._lines, monitor_messages.trajectories(waiting, time.time()), droppable=True)


class Samples:
    """Which episodes are shown whole: some a second, of every variation in turn."""

    def __init__(self, per_s: float = 4.0, burst: int = 8, again_s: float = 2.0) -> None:
        """At most ``burst`` at once; a new turn begins once none has waited for its own for ``again_s`` seconds."""
        self._per_s, self._burst, self._again_s = per_s, burst, again_s
        self._left, self._since = float(burst), float("-inf")
        self._shown: set[tuple[int, int]] = set()
        self._waited = float("-inf")

    def take(self, identity: Identity, now: float) -> bool:
        """Whether this one is shown."""
        self._left = min(self._burst, self._left + (now - self._since) * self._per_s)
        self._since = now
        place = identity.task, identity.variation
        if place in self._shown:
            if now - self._waited < self._again_s:
                return False
            self._shown.clear()
        self._waited = now
        if self._left < 1:
            return False
        self._left -= 1
        self._shown.add(place)
        return True
