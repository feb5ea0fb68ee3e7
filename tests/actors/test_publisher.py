"""What a worker shows: few messages, every trajectory in one of them, some episodes whole."""

import itertools
import threading

import pytest

from actors import publisher
from actors.publisher import Samples, Showing
from icrl_dist.stream import monitor_messages, wire
from icrl_dist.stream.link import StreamKeys
from icrl_dist.types import Identity
from tests.monitor.messages import trajectory

KEYS = StreamKeys("test")


class Heard:
    """A link that keeps what is published, and the clock that the worker looks at."""

    def __init__(self, monkeypatch):
        self.messages, self.now = [], 0.0
        monkeypatch.setattr(publisher.time, "monotonic", lambda: self.now)

    def publish(self, key, payload, droppable):
        assert droppable, "nobody who looks on may stop a worker"
        kind, fields = wire.decode_message(payload)
        if kind == "trajectories":
            assert key == KEYS.monitor("trajectories/w0")
            self.messages.append([one["identity"] for one in monitor_messages.rows(fields)])


@pytest.fixture
def heard(monkeypatch):
    return Heard(monkeypatch)


def test_the_first_at_once_the_next_together_the_last_when_flushed(heard):
    shown = Showing(heard, KEYS, "w0")
    for trial in range(25):
        heard.now = 0.01 * trial
        shown.show(trajectory(f"adapt/0/3/1/{trial}"))
    assert [len(one) for one in heard.messages] == [1, 10, 10]
    shown.flush()
    shown.flush()
    assert [len(one) for one in heard.messages] == [1, 10, 10, 4]
    assert list(itertools.chain(*heard.messages)) == [f"adapt/0/3/1/{trial}" for trial in range(25)]


def test_whoever_ends_few_episodes_tells_of_each_at_once(heard):
    shown = Showing(heard, KEYS, "w0")
    for trial in range(3):
        heard.now = 0.2 * trial
        shown.show(trajectory(f"adapt/0/3/1/{trial}"))
        assert len(heard.messages) == trial + 1


def test_a_message_holds_only_so_many(heard):
    shown = Showing(heard, KEYS, "w0")
    for trial in range(600):
        shown.show(trajectory(f"adapt/0/3/1/{trial}"))
    assert [len(one) for one in heard.messages] == [1, 256, 256]


def test_two_threads_lose_and_repeat_nothing(heard):
    shown = Showing(heard, KEYS, "w0")
    ended = threading.Event()

    def beat():
        while not ended.is_set():
            shown.flush()

    beating = threading.Thread(target=beat)
    beating.start()
    for trial in range(500):
        shown.show(trajectory(f"adapt/0/3/1/{trial}"))
    ended.set()
    beating.join()
    shown.flush()
    assert list(itertools.chain(*heard.messages)) == [f"adapt/0/3/1/{trial}" for trial in range(500)]


def test_shown_episodes_are_few_and_every_variation_has_its_turn():
    samples, shown = Samples(per_s=4.0, burst=8, again_s=2.0), []
    for trial in range(60):  # 30 variations end an episode together, four times a second
        now = 0.25 * trial
        shown += [v for v in range(30) if samples.take(Identity("adapt", 0, 0, v, trial), now)]
    assert len(shown) <= 8 + 4 * 15
    assert sorted(shown[:30]) == list(range(30))
    assert len(shown) > 38, "and then the next turn"
