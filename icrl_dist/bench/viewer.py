"""Processes for ``bench monitor``: a viewer, and a publisher with many simulated variations.

``python -m icrl_dist.bench.viewer view ENDPOINT``: on the line ``on`` of standard input it subscribes and
updates its state as a view does; on ``off`` it disconnects and prints the number of messages received.
``python -m icrl_dist.bench.viewer crowd STREAMS PER_S``: publishes like a learner and 16 workers with
``STREAMS`` variations that each end ``PER_S`` episodes per second; prints its endpoint.
"""

from __future__ import annotations

import json
import sys
import threading
import time

import numpy as np

from actors.publisher import PERIOD_S
from icrl_dist.monitor.feed import PERIOD_S as SNAPSHOT_S
from icrl_dist.monitor.feed import LiveFeed
from icrl_dist.stream import monitor_messages, wire
from icrl_dist.stream.link import StreamKeys
from icrl_dist.stream.zenoh_link import ZenohLink
from icrl_dist.types import Adversary, Identity, Task, Trajectory, Variation

_WORKERS = 16
_TRIALS = 40


def view(endpoint: str) -> None:
    """Connect and disconnect as standard input commands."""
    for line in sys.stdin:
        if line.strip() != "on":
            continue
        with ZenohLink.connect(endpoint, 30.0) as link, LiveFeed(link) as feed:
            ended = threading.Event()

            def take_snapshots(feed: LiveFeed = feed, ended: threading.Event = ended) -> None:
                since = -1
                while not ended.wait(SNAPSHOT_S):
                    snapshot = feed.state.snapshot(feed.now(), since)
                    since = snapshot["seq"]
                    json.dumps(snapshot)

            thread = threading.Thread(target=take_snapshots)
            thread.start()
            print("on", flush=True)
            sys.stdin.readline()
            ended.set()
            thread.join()
            print(feed.state.received, flush=True)


def crowd(streams: int, per_s: float) -> None:
    """Publish until standard input is closed."""
    keys = StreamKeys("crowd")
    with ZenohLink.listen("tcp/127.0.0.1:0") as link:
        print(link.endpoints[0], flush=True)
        ended = threading.Event()

        def wait() -> None:
            sys.stdin.read()
            ended.set()

        threading.Thread(target=wait, daemon=True).start()
        rows = [_episodes(worker, streams) for worker in range(_WORKERS)]
        topics = [keys.monitor(f"trajectories/w{worker}") for worker in range(_WORKERS)]
        sent, began = 0, time.monotonic()
        while not ended.wait(PERIOD_S):
            due = int((time.monotonic() - began) * per_s)  # episodes of each stream
            trials = range(sent, due)[-_TRIALS:]
            if trials:
                for topic, streams_of_worker in zip(topics, rows, strict=True):
                    link.publish(topic, _message(streams_of_worker, trials), droppable=True)
            progress = {"stage": "collect", "phase": "adapt", "round": 0, "step": 0, "steps": 1, "version": 0, "lag": 0}
            counts = {"trajectories": sent * streams, "workers": _WORKERS, "drops": {}, "doing": [], "time": time.time()}
            link.publish(keys.monitor("learner"), wire.encode_message("learner", **progress, **counts), droppable=True)
            sent = due
            print(sent * streams, flush=True)


def _episodes(worker: int, streams: int) -> list[list[Trajectory]]:
    """All trials of each of a worker's variations."""
    task = Task.of("darkroom", goal=(3, 4), size=10, horizon=100, start=(0, 0))
    adversary = Adversary.of("dirichlet", p=0.1, alpha=(0.5, 1.0, 0.5, 1.5, 0.7))
    return [
        [
            Trajectory(
                identity=Identity("adapt", 0, stream // 8, stream % 8, trial),
                variation=Variation(task, adversary),
                policy_version=0,
                weights_digest="0" * 64,
                worker=f"w{worker}",
                observations=np.zeros((101, 2), np.float32),
                actions=np.zeros(100, np.int16),
                rewards=np.full(100, trial / 100, np.float32),
                adversary=np.zeros(100, np.int16),
                queries=np.zeros((0, 2), np.float32),
                labels=np.zeros((0, 5), np.float32),
                prev_actions=np.zeros(0, np.int16),
                prev_rewards=np.zeros(0, np.float32),
                origin="none",
            )
            for trial in range(_TRIALS)
        ]
        for stream in range(worker, streams, _WORKERS)
    ]


def _message(streams: list[list[Trajectory]], trials: range) -> bytes:
    return monitor_messages.trajectories((stream[trial % _TRIALS] for stream in streams for trial in trials), time.time())


if __name__ == "__main__":
    if sys.argv[1] == "view":
        view(sys.argv[2])
    else:
        crowd(int(sys.argv[2]), float(sys.argv[3]))
