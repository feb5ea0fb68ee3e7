"""A viewer, and a crowd of streams to be viewed, as processes of their own for ``bench monitor``.

``python -m icrl_dist.bench.viewer view ENDPOINT``: ``on`` on standard input subscribes and keeps a
picture, as a view does; ``off`` lets go of it and answers how many messages it took in.
``python -m icrl_dist.bench.viewer crowd STREAMS PER_S``: a learner's endpoint, with so many
variations that each end ``PER_S`` episodes a second, of 16 workers; prints where it listens.
"""

from __future__ import annotations

import json
import sys
import threading
import time

import numpy as np

from actors.publisher import PERIOD_S
from icrl_dist.monitor.feed import PERIOD_S as LOOK_S
from icrl_dist.monitor.feed import LiveFeed
from icrl_dist.stream import monitor_messages, wire
from icrl_dist.stream.link import StreamKeys
from icrl_dist.stream.zenoh_link import ZenohLink
from icrl_dist.types import Adversary, Identity, Task, Trajectory, Variation

_WORKERS = 16
_TRIALS = 40


def view(endpoint: str) -> None:
    """Watch by turns, as standard input says."""
    for line in sys.stdin:
        if line.strip() != "on":
            continue
        with ZenohLink.connect(endpoint, 30.0) as link, LiveFeed(link) as feed:
            ended = threading.Event()

            def look(feed: LiveFeed = feed, ended: threading.Event = ended) -> None:
                since = -1
                while not ended.wait(LOOK_S):
                    shown = feed.picture.snapshot(feed.now(), since)
                    since = shown["seq"]
                    json.dumps(shown)

            looking = threading.Thread(target=look)
            looking.start()
            print("on", flush=True)
            sys.stdin.readline()
            ended.set()
            looking.join()
            print(feed.picture.heard, flush=True)


def crowd(streams: int, per_s: float) -> None:
    """Publish until standard input ends."""
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
                for topic, told in zip(topics, rows, strict=True):
                    link.publish(topic, _message(told, trials), droppable=True)
            progress = {"stage": "collect", "phase": "adapt", "round": 0, "step": 0, "steps": 1, "version": 0, "lag": 0}
            counts = {"trajectories": sent * streams, "workers": _WORKERS, "drops": {}, "doing": [], "time": time.time()}
            link.publish(keys.monitor("learner"), wire.encode_message("learner", **progress, **counts), droppable=True)
            sent = due
            print(sent * streams, flush=True)


def _episodes(worker: int, streams: int) -> list[list[Trajectory]]:
    """Of each of a worker's streams, all of its trials."""
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
                taken=np.zeros(0, np.int16),
                gained=np.zeros(0, np.float32),
                origin="none",
            )
            for trial in range(_TRIALS)
        ]
        for stream in range(worker, streams, _WORKERS)
    ]


def _message(told: list[list[Trajectory]], trials: range) -> bytes:
    return monitor_messages.trajectories((one[trial % _TRIALS] for one in told for trial in trials), time.time())


if __name__ == "__main__":
    if sys.argv[1] == "view":
        view(sys.argv[2])
    else:
        crowd(int(sys.argv[2]), float(sys.argv[3]))
