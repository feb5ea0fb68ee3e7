"""A viewer, and a crowd of streams to be viewed, as processes of their own for ``bench monitor``.

``python -m icrl_dist.bench.viewer view ENDPOINT``: ``on`` on standard input subscribes and keeps a
picture, as a view does; ``off`` lets go of it and answers how many messages it took in.
``python -m icrl_dist.bench.viewer crowd STREAMS PER_S``: a learner's endpoint, with so many
variations that each end ``PER_S`` episodes a second; prints where it listens.
"""

from __future__ import annotations

import json
import sys
import threading
import time

from icrl_dist.monitor.feed import PERIOD_S, LiveFeed
from icrl_dist.stream import wire
from icrl_dist.stream.link import Keys
from icrl_dist.stream.zenoh_link import ZenohLink

_WORKERS = 16
_TRIALS = 40
_SLICE_S = 0.02


def view(endpoint: str) -> None:
    """Watch by turns, as standard input says."""
    for line in sys.stdin:
        if line.strip() != "on":
            continue
        with ZenohLink.connect(endpoint, 30.0) as link, LiveFeed(link) as feed:
            ended = threading.Event()

            def look(feed: LiveFeed = feed, ended: threading.Event = ended) -> None:
                since = -1
                while not ended.wait(PERIOD_S):
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
    keys = Keys("crowd")
    with ZenohLink.listen("tcp/127.0.0.1:0") as link:
        print(link.endpoints[0], flush=True)
        ended = threading.Event()

        def wait() -> None:
            sys.stdin.read()
            ended.set()

        threading.Thread(target=wait, daemon=True).start()
        messages = [[_episode(stream, trial) for trial in range(_TRIALS)] for stream in range(streams)]
        topics = [keys.monitor(f"trajectory/w{worker}") for worker in range(_WORKERS)]
        sent, began = 0, time.monotonic()
        while not ended.wait(_SLICE_S):
            due = int((time.monotonic() - began) * per_s * streams)
            for number in range(sent, due):
                stream, trial = number % streams, number // streams % _TRIALS
                link.publish(topics[stream % _WORKERS], messages[stream][trial], droppable=True)
            sent = due
            print(sent, flush=True)


def _episode(stream: int, trial: int) -> bytes:
    return wire.encode_message(
        "trajectory",
        identity=f"adapt/0/{stream // 8}/{stream % 8}/{trial}",
        problem="darkroom",
        task={"goal": [3, 4], "size": 10, "horizon": 100, "start": [0, 0]},
        adversary={"kind": "dirichlet", "p": 0.1, "alpha": [0.5, 1.0, 0.5, 1.5, 0.7]},
        episode_return=float(trial),
        steps=100,
        weights=0,
        digest="0" * 64,
        worker=f"w{stream % _WORKERS}",
        time=time.time(),
    )


if __name__ == "__main__":
    if sys.argv[1] == "view":
        view(sys.argv[2])
    else:
        crowd(int(sys.argv[2]), float(sys.argv[3]))
