"""A worker publishes few messages, every trajectory once, and some complete episodes."""

import itertools
import threading
import time

import pytest

from actors.publisher import EpisodeSampler, TrajectoryPublisher
from icrl_dist.stream import monitor_messages, wire
from icrl_dist.stream.link import StreamKeys
from icrl_dist.types import Identity
from tests.monitor.messages import trajectory

KEYS = StreamKeys("test")


class RecordingLink:
    """Keeps the published messages; ``now`` replaces the clock of the publisher."""

    def __init__(self, monkeypatch):
        self.messages, self.now = [], 0.0
        monkeypatch.setattr(time, "monotonic", lambda: self.now)

    def publish(self, key, payload, droppable):
        assert droppable, "a viewer must not be able to block a worker"
        kind, fields = wire.decode_message(payload)
        if kind == "trajectories":
            assert key == KEYS.monitor("trajectories/w0")
            self.messages.append([one["identity"] for one in monitor_messages.rows(fields)])


@pytest.fixture
def link(monkeypatch):
    return RecordingLink(monkeypatch)


def test_the_first_is_sent_at_once_the_next_together_the_rest_by_flush(link):
    publisher = TrajectoryPublisher(link, KEYS, "w0")
    for trial in range(25):
        link.now = 0.01 * trial
        publisher.publish(trajectory(f"adapt/0/3/1/{trial}"))
    assert [len(one) for one in link.messages] == [1, 10, 10]
    publisher.flush()
    publisher.flush()
    assert [len(one) for one in link.messages] == [1, 10, 10, 4]
    assert list(itertools.chain(*link.messages)) == [f"adapt/0/3/1/{trial}" for trial in range(25)]


def test_rare_episodes_are_each_sent_at_once(link):
    publisher = TrajectoryPublisher(link, KEYS, "w0")
    for trial in range(3):
        link.now = 0.2 * trial
        publisher.publish(trajectory(f"adapt/0/3/1/{trial}"))
        assert len(link.messages) == trial + 1


def test_a_message_has_a_maximum_of_trajectories(link):
    publisher = TrajectoryPublisher(link, KEYS, "w0")
    for trial in range(600):
        publisher.publish(trajectory(f"adapt/0/3/1/{trial}"))
    assert [len(one) for one in link.messages] == [1, 256, 256]


def test_with_two_threads_each_trajectory_is_sent_once(link):
    publisher = TrajectoryPublisher(link, KEYS, "w0")
    ended = threading.Event()

    def beat():
        while not ended.is_set():
            publisher.flush()

    beating = threading.Thread(target=beat)
    beating.start()
    for trial in range(500):
        publisher.publish(trajectory(f"adapt/0/3/1/{trial}"))
    ended.set()
    beating.join()
    publisher.flush()
    assert list(itertools.chain(*link.messages)) == [f"adapt/0/3/1/{trial}" for trial in range(500)]


def test_selected_episodes_are_few_and_every_variation_has_its_turn():
    sampler, selected = EpisodeSampler(per_s=4.0, burst=8, again_s=2.0), []
    for trial in range(60):  # 30 variations end an episode together, four times a second
        now = 0.25 * trial
        selected += [v for v in range(30) if sampler.take(Identity("adapt", 0, 0, v, trial), now)]
    assert len(selected) <= 8 + 4 * 15
    assert sorted(selected[:30]) == list(range(30))
    assert len(selected) > 38, "the next turn has started"
