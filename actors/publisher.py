"""Publisher: sends a summary of each trajectory, and some complete episodes, to the monitor plane."""

from __future__ import annotations

import threading
import time

from icrl_dist.stream import monitor_messages
from icrl_dist.stream.link import Link, StreamKeys
from icrl_dist.types import Identity, Trajectory

PERIOD_S = 0.1
"""Seconds between two messages at least: a message costs as much as a hundred summaries in it."""
_MAX_SUMMARIES = 256
"""Trajectories per message."""


class TrajectoryPublisher:
    """Publishes the trajectories of one worker on the monitor plane; several threads may use it."""

    def __init__(self, link: Link, keys: StreamKeys, worker: str) -> None:
        self._link, self._lock = link, threading.Lock()
        self._summaries, self._episodes = keys.monitor(f"trajectories/{worker}"), keys.monitor(f"episode/{worker}")
        self._waiting: list[Trajectory] = []
        self._sent = float("-inf")
        self._sampler = EpisodeSampler()

    def publish(self, trajectory: Trajectory) -> None:
        """Publish a trajectory, now or together with those of the next ``PERIOD_S``.

        Call ``flush`` after the last one.  Raises LinkError if the link is closed.
        """
        now = time.monotonic()
        with self._lock:
            self._waiting.append(trajectory)
            if now - self._sent >= PERIOD_S or len(self._waiting) >= _MAX_SUMMARIES:
                self._send(now)
            complete = self._sampler.take(trajectory.identity, now)
        if complete:
            self._link.publish(self._episodes, monitor_messages.episode(trajectory, time.time()), droppable=True)

    def flush(self) -> None:
        """Publish the waiting summaries.  Raises LinkError if the link is closed."""
        with self._lock:
            if self._waiting:
                self._send(time.monotonic())

    def _send(self, now: float) -> None:
        waiting, self._waiting, self._sent = self._waiting, [], now
        self._link.publish(self._summaries, monitor_messages.trajectories(waiting, time.time()), droppable=True)


class EpisodeSampler:
    """Selects the episodes that are published completely: a few per second, from each variation in turn."""

    def __init__(self, per_s: float = 4.0, burst: int = 8, again_s: float = 2.0) -> None:
        """Selects ``per_s`` episodes per second, at most ``burst`` at once.

        A new turn starts when no episode of a variation without a selected one has come for ``again_s`` seconds.
        """
        self._per_s, self._burst, self._again_s = per_s, burst, again_s
        self._budget, self._since = float(burst), float("-inf")
        self._selected: set[tuple[int, int]] = set()
        self._last_unselected = float("-inf")

    def take(self, identity: Identity, now: float) -> bool:
        """Whether this episode is selected."""
        self._budget = min(self._burst, self._budget + (now - self._since) * self._per_s)
        self._since = now
        variation = identity.task, identity.variation
        if variation in self._selected:
            if now - self._last_unselected < self._again_s:
                return False
            self._selected.clear()
        self._last_unselected = now
        if self._budget < 1:
            return False
        self._budget -= 1
        self._selected.add(variation)
        return True
