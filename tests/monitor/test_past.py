"""A view that joins late, or that lost messages, shows the same numbers as one that received everything."""

import threading
import time

import pytest

from icrl_dist.launch import train
from icrl_dist.monitor import past
from icrl_dist.monitor.feed import LiveFeed
from icrl_dist.monitor.past import Past
from icrl_dist.stream import wire
from icrl_dist.stream.link import Refused, StreamKeys, Unanswered
from icrl_dist.stream.memory_link import MemoryHub
from icrl_dist.stream.validation import WireError
from icrl_dist.stream.zenoh_link import ZenohLink
from icrl_dist.telemetry.metrics import Metrics
from learner import service
from learner.past import PastServer
from tests.monitor.messages import progress, run_info


def until(condition):
    deadline = time.monotonic() + 60
    while not condition():
        assert time.monotonic() < deadline
        time.sleep(0.02)


class LossyFeed(LiveFeed):
    """A view that loses every third message about trajectories."""

    lost = 0

    def _receive(self, key, payload):
        if "/mon/trajectories/" in key:
            self.lost += 1
            if self.lost % 3 == 0:
                return
        super()._receive(key, payload)


def shown(feed):
    """What a view shows of finished rounds, once every optimum is computed."""

    def solved():
        rows = feed.state.snapshot(time.time())["variations"]
        return rows and all(phase["optimum"] is not None for row in rows for phase in row["phases"])

    until(solved)
    snapshot = feed.state.snapshot(time.time())
    return snapshot["averages"], {row["name"]: row["phases"] for row in snapshot["variations"]}


class Watched:
    """A run in this process, watched from its start by a view that loses messages."""

    def __init__(self, run, folder):
        from actors.worker import Worker

        self.hub, self.folder, self.run = MemoryHub(), folder, run
        train.prepare(run, folder, resume=False, overwrite=False)
        self.service = service.Service(run, folder, self.hub.link(), lambda event: None)
        self.early = LossyFeed(self.hub.link())
        worker = Worker(self.hub.link(), folder.name, "w0")
        thread = threading.Thread(target=worker.run, daemon=True)
        thread.start()
        self.result = self.service.run()
        self.service._reporter.flush()
        self.service.worker_api.finish()
        worker.stop()
        thread.join(30)

    def ask(self, payload):
        with self.hub.link() as link:
            return link.request(StreamKeys(self.folder.name).past, payload, 10.0)


@pytest.fixture(scope="module")
def watched(module_run, tmp_path_factory):
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(service, "Metrics", lambda folder, **options: Metrics(folder, tensorboard=False, **options))
        one = Watched(module_run, tmp_path_factory.mktemp("runs") / "watched")
    yield one
    one.early.close()
    one.service.close()


def test_a_view_that_joins_at_the_end_shows_the_numbers_of_one_that_joined_at_the_start(watched):
    with LiveFeed(watched.hub.link(), "watched") as late:
        until(lambda: len(late.state.snapshot(0.0)["averages"]) == 3 and not late.state.past)
        averages, phases = shown(late)
        until(lambda: shown(watched.early)[1] == phases)
        assert watched.early.lost > 6 and shown(watched.early)[0] == averages
        assert [(one["name"], one["variations"], one["of"]) for one in averages][1:] == [
            ("adapt/0", 21, 21),
            ("adapt/1", 21, 21),
        ]
        run = late.state.snapshot(time.time())["run"]
        assert (run["state"], run["version"], run["variations"]) == ("finished", 2, 21)
        texts = [event["text"] for event in late.state.snapshot(time.time())["events"]]
        assert [text[:13] for text in texts if text.startswith("T^")] == [f"T^{n} is fitted" for n in range(3)]
        assert late.state.ignored == {}


def test_the_past_does_not_count_as_episodes_of_now(watched):
    with LiveFeed(watched.hub.link(), "watched") as late:
        until(lambda: late.state.past == "" and late.state.snapshot(0.0)["variation_count"] == 21)
        time.sleep(1.2)  # at least one point after the past
        assert set(late.state.snapshot(0.0)["series"]["episodes_per_s"]) <= {None, 0.0}


def test_pages_are_bounded_and_complete(watched, monkeypatch):
    monkeypatch.setattr(past, "_PAGE", (2, 10))
    maker = Past(watched.run, watched.folder, watched.service.store)
    after, seen, pages = "", [], 0
    while True:
        messages, after = past.parse_reply(maker.answer(past.request("adapt/1", after)))
        for _, _, payload in messages:
            for entry in wire.decode_message(payload)[1]["variations"]:
                seen += [f"{entry['identity']}/{trial}" for trial in entry["trials"]]
        pages += 1
        if not after:
            break
    index = watched.service.store.index
    assert pages == 11 and sorted(seen) == sorted(str(row.identity) for row in index if str(row.identity).startswith("adapt/1"))
    assert past.parse_reply(maker.answer(past.request("adapt/7"))) == ([], "")


@pytest.mark.parametrize(
    "payload",
    [
        b"\xc1",
        wire.encode_message("past"),
        wire.encode_message("other", phase="", after=""),
        past.request("adapt"),
        past.request("adapt/-1"),
        past.request("adapt/1", "0"),
        past.request("evaluate/0"),
        past.request("adapt/1", "0/0" + " " * 600),
    ],
)
def test_an_invalid_request_is_refused(watched, payload):
    with pytest.raises(Refused):
        watched.ask(payload)


def test_an_invalid_reply_is_refused():
    for messages in (1, [1], [[1, "k", b""]], [[1.0, "k", "x"]], [[1.0, "k"]]):
        with pytest.raises(WireError):
            past.parse_reply(wire.encode_message("past", messages=messages, after=""))
    with pytest.raises(WireError):
        past.parse_reply(wire.encode_message("other", messages=[], after=""))


def test_without_a_request_no_thread_runs_and_a_closed_server_refuses(watched, hub):
    link = hub()
    server = PastServer(link, StreamKeys("quiet"), watched.run, watched.folder, watched.service.store)
    assert server._thread is None
    past.parse_reply(link.request(StreamKeys("quiet").past, past.request(), 10.0))
    thread = server._thread
    server.close()
    assert thread is not None and not thread.is_alive()
    with pytest.raises(Refused, match="busy"):
        link.request(StreamKeys("quiet").past, past.request(), 10.0)


def test_requests_beyond_the_queue_are_refused_and_the_learner_rests_between_answers(watched, hub, monkeypatch):
    link, answered = hub(), []

    def slow(self, payload):
        time.sleep(0.05)
        return b"x"

    monkeypatch.setattr(Past, "answer", slow)
    server = PastServer(link, StreamKeys("busy"), watched.run, watched.folder, watched.service.store)
    began = time.monotonic()
    for _ in range(20):
        link.send(StreamKeys("busy").past, past.request(), 30.0, lambda outcome: answered.append(outcome))
    until(lambda: len(answered) >= 13)
    assert sum(isinstance(one, Refused) for one in answered) >= 11, "eight wait, one is being answered"
    until(lambda: sum(one == b"x" for one in answered) >= 2)
    assert time.monotonic() - began > 0.5, "a tenth of the time"
    server.close()


def test_a_learner_that_does_not_answer_is_shown_as_such(hub):
    link = hub()
    with LiveFeed(hub()) as feed:
        link.publish("icrl/demo/mon/run", run_info(), droppable=True)
        link.publish("icrl/demo/mon/learner", progress(), droppable=True)
        until(lambda: feed.state.snapshot(0.0)["run"].get("step") == 10)
        assert feed.state.snapshot(0.0)["past"] == "missing"


def test_a_lost_answer_is_asked_for_again(hub, watched):
    link, requests = hub(), []

    def serve(query):
        requests.append(query.payload)
        if len(requests) == 2:
            query.refuse("busy")
        else:
            query.reply(watched.ask(query.payload))

    past_of = StreamKeys("watched").past
    served = hub()
    served.serve(past_of, lambda query: threading.Thread(target=serve, args=(query,)).start())
    with LiveFeed(link, "watched") as feed:
        until(lambda: feed.state.snapshot(0.0)["variation_count"] == 21 and not feed.state.past)
    assert requests[1] == requests[2]


def test_nobody_answers_without_a_learner(hub):
    with pytest.raises(Unanswered):
        hub().request(StreamKeys("demo").past, past.request(), 1.0)


@pytest.mark.integration
def test_the_past_is_read_between_processes_too(watched):
    with ZenohLink.listen("tcp/127.0.0.1:0") as learner:
        server = PastServer(learner, StreamKeys("watched"), watched.run, watched.folder, watched.service.store)
        with (
            ZenohLink.connect(learner.endpoints[0], 10.0) as link,
            LiveFeed(link, "watched") as late,
            LiveFeed(watched.hub.link(), "watched") as other,
        ):
            for feed in (late, other):
                until(lambda feed=feed: feed.state.snapshot(0.0)["variation_count"] == 21 and not feed.state.past)
            assert shown(late) == shown(other)
        server.close()
