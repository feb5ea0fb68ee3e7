"""A worker against a scripted learner on a MemoryLink."""

import dataclasses
import json
import threading
import time
from typing import Any, cast

import numpy as np
import pytest
import torch

import icrl_dist
from actors import beliefs
from actors import worker as worker_module
from actors.beliefs import BeliefPublisher
from actors.watchdog import Watchdog
from actors.weight_cache import WeightCache
from actors.worker import Worker
from icrl_dist.collect import kinds
from icrl_dist.collect.adapt import Rollouts
from icrl_dist.collect.behavior import BehaviorContexts
from icrl_dist.config import plugins
from icrl_dist.config.run import dumps
from icrl_dist.interfaces import Policy
from icrl_dist.methods import registry as methods
from icrl_dist.models import kernel
from icrl_dist.models.compiled import Unusable
from icrl_dist.models.weights import weights_of
from icrl_dist.problems import registry
from icrl_dist.problems.darkroom.posterior import RoomPosterior
from icrl_dist.stream import batching, monitor_messages, wire
from icrl_dist.stream.link import Refused, StreamKeys, Unanswered
from icrl_dist.stream.memory_link import MemoryHub
from icrl_dist.types import Weights
from tests.calls import keeping
from tests.contracts.link_battery import eventually
from tests.jobs import jobs_of
from tests.stream.examples import trajectory
from tests.toys.site import CORRIDOR, SLIPPERY, installed

KEYS = StreamKeys("test")


def test_a_trajectory_that_the_learner_would_drop_is_not_sent():
    payload = worker_module._encoded(trajectory(), 1 << 20)
    assert len(batching.join([payload])) <= len(payload) + worker_module._ENVELOPE
    with pytest.raises(wire.WireError, match=r"oversized: .*raise stream\.max_message_bytes = 100"):
        worker_module._encoded(trajectory(), 100)


def untrained(run):
    return methods.of(run).build(registry.of(run).spec, run)


def weights(run, version):
    torch.manual_seed(version)
    arrays = weights_of(untrained(run))
    return Weights(version, arrays, wire.weights_digest(arrays))


class ScriptedLearner:
    """Answers requests for jobs from a list, and keeps the requests and trajectories."""

    def __init__(self, link, run, answers):
        self.run, self.answers, self.requests, self.stored = run, list(answers), [], []
        self.refused = set()
        link.serve(KEYS.work, self.work)
        link.serve(KEYS.data, self.data)

    def work(self, query):
        kind, fields = wire.decode_message(query.payload)
        self.requests.append((kind, fields))
        if kind == "hello":
            query.reply(wire.encode_message("hello", run=dumps(self.run)))
        elif kind == "failed":
            query.reply(wire.encode_message("noted"))
        else:
            query.reply(self.answers.pop(0))

    def data(self, query):
        for one in batching.split(query, 1 << 20):
            trajectory = wire.decode_trajectory(one.payload, 1 << 20)
            if trajectory.identity in self.refused:
                one.refuse(f"not-finite: {trajectory.identity}: a value is infinite")
            else:
                self.stored.append(trajectory)
                one.reply(b"stored")


def job_message(job, data=None):
    return wire.encode_message("job", name=list(job.name), job=data or wire.encode_job(job), deadline_s=60.0)


STOP = wire.encode_message("stop")


def test_a_worker_does_its_job_under_its_name_and_stops(hub, small_run):
    job = jobs_of(small_run, "icag")[2]
    learner = ScriptedLearner(hub(), small_run, [wire.encode_message("wait", seconds=0.01), job_message(job), STOP])
    seen = []
    watching = hub()
    watching.subscribe(KEYS.monitor_all, lambda key, payload: seen.append(wire.decode_message(payload)))
    Worker(hub(), "test", "w7").run()
    assert [t.identity for t in learner.stored] == list(job.identities())
    assert {t.worker for t in learner.stored} == {"w7"}
    assert learner.requests[0][1]["version"] == icrl_dist.__version__
    assert [kind for kind, _ in learner.requests] == ["hello", "ask", "ask", "ask"]
    published = lambda: [  # noqa: E731
        row["identity"] for kind, fields in list(seen) if kind == "trajectories" for row in monitor_messages.rows(fields)
    ]
    eventually(lambda: published() == [str(i) for i in job.identities()])  # messages are delivered on another thread


def test_a_job_that_raises_is_reported_and_the_worker_continues(hub, small_run):
    good, other = jobs_of(small_run, "icag")[:2]
    assert isinstance(other.payload, BehaviorContexts)
    bad = dataclasses.replace(other, payload=dataclasses.replace(other.payload, behaviors=()))
    learner = ScriptedLearner(hub(), small_run, [job_message(bad), job_message(good), STOP])
    Worker(hub(), "test", "w0").run()
    (report,) = [fields for kind, fields in learner.requests if kind == "failed"]
    assert report["job"] == list(bad.name) and report["file"] == ""
    record = report["record"]
    assert "ZeroDivisionError" in record["exception"] and ".py:" in record["exception"]
    first = next(iter(bad.identities()))
    assert (record["identity"], record["seed"], record["spawn_key"]) == (str(first), bad.seed, list(first.key()))
    assert record["job"] == bad.label and record["worker"] == "w0" and record["variations"] == len(bad.variations)
    assert 10 < record["memory_mb"] <= record["peak_mb"]
    assert "Traceback" in record["traceback"] and "behavior.py" in record["traceback"]
    assert len(learner.stored) == len(list(good.identities()))


@dataclasses.dataclass(frozen=True)
class FromANewerRelease(BehaviorContexts):
    speed: float = 1.0


def raises_type_error(kind, problem, data):
    raise TypeError("the payload of another package")


@pytest.mark.parametrize("case", ["unknown field", "not msgpack", "error of another package"])
def test_a_job_that_cannot_be_decoded_is_reported_and_the_worker_continues(hub, small_run, monkeypatch, tmp_path, case):
    bad, good = jobs_of(small_run, "icag")[:2]
    monkeypatch.setattr(worker_module, "Watchdog", lambda run, name: Watchdog(None, name))  # pytest's process has one
    data, cause, answers = None, "unknown key payload.speed", [job_message(good)]
    if case == "unknown field":
        assert isinstance(bad.payload, BehaviorContexts)
        payload = FromANewerRelease(bad.payload.behaviors, bad.payload.labelling)
        data = wire.encode_job(dataclasses.replace(bad, payload=payload))
    elif case == "not msgpack":
        data, cause = b"\xc1", "WireError: not-msgpack"
    else:
        monkeypatch.setattr(kinds, "read_payload", raises_type_error)
        cause, answers = "TypeError: the payload of another package", []
    learner = ScriptedLearner(hub(), small_run, [job_message(bad, data), *answers, STOP])
    Worker(hub(), "test", "w0", folder=tmp_path).run()
    (report,) = [fields for kind, fields in learner.requests if kind == "failed"]
    assert (report["job"], report["file"]) == (list(bad.name), "w0-1.json")
    record = report["record"]
    assert cause in record["exception"] and record["job"] == "/".join(map(str, bad.name)) and record["worker"] == "w0"
    assert json.loads((tmp_path / "crashes" / "w0-1.json").read_text()) == record
    assert len(learner.stored) == (len(list(good.identities())) if answers else 0)


def test_the_record_contains_the_identity_of_the_unfinished_trajectory(hub, small_run, monkeypatch, tmp_path):
    job = jobs_of(small_run, "icag")[0]
    real = kinds.do

    def breaks_at_the_third(*given):
        work = real(*given)
        yield next(work)
        yield next(work)
        raise ZeroDivisionError("\udcff the room broke")

    monkeypatch.setattr(kinds, "do", breaks_at_the_third)
    learner = ScriptedLearner(hub(), small_run, [job_message(job), STOP])
    monkeypatch.setattr(worker_module, "Watchdog", lambda run, name: Watchdog(None, name))  # pytest's process has one
    monkeypatch.setattr(worker_module._log, "exception", lambda *texts: None)  # a log file may not accept this text
    Worker(hub(), "test", "w3", folder=tmp_path).run()
    (report,) = [fields for kind, fields in learner.requests if kind == "failed"]
    assert [t.identity for t in learner.stored] == list(job.identities())[:2]
    assert report["record"]["identity"] == str(list(job.identities())[2])
    assert report["file"] == "w3-1.json"
    assert json.loads((tmp_path / "crashes" / "w3-1.json").read_text()) == report["record"]


def test_a_refused_trajectory_fails_its_own_job_only(hub, small_run):
    bad, good = jobs_of(small_run, "icag")[:2]
    learner = ScriptedLearner(hub(), small_run, [job_message(bad), job_message(good), STOP])
    learner.refused = set(list(bad.identities())[:5])
    Worker(hub(), "test", "w0").run()
    (report,) = [fields for kind, fields in learner.requests if kind == "failed"]
    assert report["job"] == list(bad.name)
    assert "Refused: not-finite: pretrain/0/0/0/0" in report["record"]["exception"] and report["record"]["identity"] == ""
    assert {t.identity for t in learner.stored} >= set(good.identities())


def test_every_request_has_counters_and_heartbeats_continue_during_a_job(hub, small_run, monkeypatch):
    monkeypatch.setattr(worker_module, "HEARTBEAT_S", 0.01)
    job = jobs_of(small_run, "icag")[0]
    heartbeats = []
    beaten = threading.Event()
    watching = hub()

    def receive(_, payload):
        heartbeats.append(wire.decode_message(payload))
        if sum(fields["job"] == job.label for _, fields in heartbeats) == 3:
            beaten.set()

    watching.subscribe(KEYS.heartbeats, receive)
    real = kinds.do

    def stuck_for_three_beats(*given):
        assert beaten.wait(30)
        return real(*given)

    monkeypatch.setattr(kinds, "do", stuck_for_three_beats)
    learner = ScriptedLearner(hub(), small_run, [job_message(job), STOP])
    Worker(hub(), "test", "w0").run()
    asks = [fields for kind, fields in learner.requests if kind == "ask"]
    count = len(list(job.identities()))
    counters = [{name: ask[name] for name in ("episodes", "steps", "trajectories", "resent")} for ask in asks]
    assert counters[0] == dict.fromkeys(counters[0], 0)
    assert counters[1] == {"episodes": count, "steps": count * small_run.darkroom.horizon, "trajectories": count, "resent": 0}
    assert {kind for kind, _ in heartbeats} == {"worker"}
    assert all(fields["worker"] == "w0" and fields["memory_mb"] > 10 and fields["waited_s"] >= 0 for _, fields in heartbeats)


def test_hello_names_the_code_of_problems_and_methods_of_other_packages(small_run, tmp_path):
    said = []
    for name, text in (("one", CORRIDOR), ("other", SLIPPERY)):
        network = MemoryHub().link
        learner = ScriptedLearner(network(), small_run, [STOP])
        with installed(tmp_path / name, {"toy_problem.py": text}):
            Worker(network(), "test", "w0").run()
            assert learner.requests[0][1]["plugins"] == {"problems/toy": list(plugins.sources()["problems/toy"])}
        said.append(learner.requests[0][1]["plugins"]["problems/toy"])
    assert said[0][:2] == said[1][:2] == ["toys", "1.0"] and said[0][2] != said[1][2]


def test_a_refused_hello_ends_the_worker_with_the_reason(hub):
    hub().serve(KEYS.work, lambda query: query.refuse("schema: worker runs another version"))
    with pytest.raises(Refused, match="another version"):
        Worker(hub(), "test", "w0").run()


def test_a_worker_without_the_kernel_does_no_job_of_a_run_by_the_kernel(hub, small_run, monkeypatch):
    monkeypatch.setattr(kernel, "library", lambda name: Unusable("not compiled", "run `make kernel`"))
    run = dataclasses.replace(small_run, context=dataclasses.replace(small_run.context, decoder="kernel"))
    learner = ScriptedLearner(hub(), run, [])
    with pytest.raises(Refused, match=r"^context\.decoder = 'kernel': on .*: not compiled: run `make kernel`; or begin"):
        Worker(hub(), "test", "w0").run()
    assert [kind for kind, _ in learner.requests] == ["hello"] and learner.stored == []


def test_a_worker_ends_when_the_learner_does_not_answer_for_long(hub):
    with pytest.raises(Unanswered):
        Worker(hub(), "test", "w0", patience_s=0.3).run()


@pytest.fixture
def committed_run(small_run):
    more = {"model": {"window": 3}, "pretrain": {"windows": 1}, "optim": {"windows": 1}}
    parts = {name: dataclasses.replace(getattr(small_run, name), **numbers) for name, numbers in more.items()}
    return dataclasses.replace(small_run, **parts)


def always(monkeypatch):
    """Publish the belief at every decision."""
    monkeypatch.setattr(beliefs, "PERIOD_S", 0.0)
    monkeypatch.setattr(beliefs, "SHARE", float("inf"))


@pytest.mark.parametrize("deploy", ["paper", "committed"])
def test_viewers_receive_beliefs_and_change_no_byte(committed_run, deploy, monkeypatch):
    always(monkeypatch)
    job = jobs_of(committed_run, phase=1)[0]
    assert isinstance(job.payload, Rollouts)
    job = dataclasses.replace(job, payload=dataclasses.replace(job.payload, deploy=deploy, context_max=20))

    def work(topic):
        network = MemoryHub().link
        learner = ScriptedLearner(network(), committed_run, [job_message(job), STOP])
        latest = wire.encode_weights(weights(committed_run, 0))
        network().serve(KEYS.weights_latest, lambda query: query.reply(latest))
        messages = []
        network().subscribe(KEYS.monitor(topic), lambda key, payload: messages.append(wire.decode_message(payload)))
        read = list[Any]()
        with monkeypatch.context() as patched:
            patched.setattr(RoomPosterior, "read", keeping(read, RoomPosterior.read))
            Worker(network(), "test", "w0").run()
        return [wire.trajectory_digest(t) for t in learner.stored], messages, read

    watched, messages, read = work("belief/w0")
    unwatched, _, unread = work("belief/w1")
    assert watched == unwatched and len(watched) == len(list(job.identities()))
    decisions = job.trials * committed_run.darkroom.horizon
    assert len(read) == decisions and not unread
    shown = [identity for identity in job.identities() if (identity.task, identity.variation) == job.rows()[-1]]
    assert [fields["identity"] for _, fields in messages][:: committed_run.darkroom.horizon] == [str(one) for one in shown]
    kind, fields = messages[-1]
    variation = job.variation(shown[-1])
    assert (kind, fields["worker"], fields["size"]) == ("belief", "w0", 3)
    assert tuple(fields["goal"]) == variation.task.vector("goal")
    assert sum(fields["implied"]) == pytest.approx(1, abs=1e-4) and sum(fields["exact"]) == pytest.approx(1, abs=1e-4)
    assert fields["exact"] == pytest.approx(read[-1].exact, abs=1e-5)
    kept = [fields["transitions"] for _, fields in messages]
    assert kept[0] == 0 and max(kept) <= 20 + committed_run.darkroom.horizon and fields["time"] > 1e9
    assert (kept[1] == 1) == (deploy == "committed"), "Algorithm 1 adds an episode to the context at its end"


def test_beliefs_use_a_bounded_share_of_the_time(hub, small_run, monkeypatch):
    link, watching, clock, cost = hub(), hub(), [100.0, 0.0], 0.02
    watching.subscribe(KEYS.monitor("belief/w0"), lambda key, payload: None)
    monkeypatch.setattr(time, "monotonic", lambda: clock[0])
    monkeypatch.setattr(time, "thread_time", lambda: clock[1])
    publish_belief = BeliefPublisher(link, KEYS.monitor("belief/w0"), "w0", registry.of(small_run))
    read = []

    def message(*arguments):
        read.append(clock[0])
        clock[1] += cost
        return b""

    monkeypatch.setattr(publish_belief, "_message", message)
    job = jobs_of(small_run, phase=1)[0]
    identity = next(iter(job.identities()))

    def published_in(seconds):
        read.clear()
        for _ in range(seconds * 10):
            clock[0] += 0.1
            publish_belief(cast(Policy, None), 0, identity, job.variation(identity))
        return len(read)

    assert published_in(80) * cost <= 80 / 200 + cost and read[-1] - read[-2] >= 4.0
    cost = 0.001
    published_in(5)
    assert published_in(20) == pytest.approx(20, abs=2), "at most once per second"


def test_an_error_in_a_belief_does_not_fail_the_job(hub, small_run, monkeypatch, caplog):
    always(monkeypatch)
    monkeypatch.setattr(RoomPosterior, "read", lambda *arguments: 1 / 0)
    job = jobs_of(small_run, phase=1)[0]
    learner = ScriptedLearner(hub(), small_run, [job_message(job), STOP])
    hub().serve(KEYS.weights_latest, lambda query: query.reply(wire.encode_weights(weights(small_run, 0))))
    hub().subscribe(KEYS.monitor_all, lambda key, payload: None)
    Worker(hub(), "test", "w0").run()
    assert len(learner.stored) == len(list(job.identities()))
    assert "a belief could not be published: division by zero" in caplog.text


def test_the_policy_waits_for_exactly_the_requested_version(hub, small_run):
    learner = hub()
    latest = [b""]
    learner.serve(KEYS.weights_latest, lambda q: q.reply(latest[0]) if latest[0] else q.refuse("busy"))
    policy = WeightCache(hub(), KEYS, untrained(small_run), 1 << 20, timeout_s=5.0)
    zero, one = weights(small_run, 0), weights(small_run, 1)
    threading.Timer(0.3, lambda: learner.publish(KEYS.weights, wire.encode_weights(zero), droppable=False)).start()
    model, digest = policy.at(0)
    assert digest == zero.digest
    np.testing.assert_array_equal(weights_of(model)["head.weight"], zero.arrays["head.weight"])
    latest[0] = wire.encode_weights(one)
    model, digest = policy.at(1)
    assert digest == one.digest
    np.testing.assert_array_equal(weights_of(model)["head.weight"], one.arrays["head.weight"])
    assert policy.at(0)[1] == zero.digest, "a repeated job of an earlier round"
    with pytest.raises(Unanswered, match="version 0 is gone; the learner is at 1"):
        WeightCache(hub(), KEYS, untrained(small_run), 1 << 20).at(0)


def test_the_policy_requests_an_older_version_by_number_and_drops_the_oldest(hub, small_run):
    learner = hub()
    versions = [weights(small_run, v) for v in range(7)]
    requested = []

    def answer(query):
        requested.append(wire.decode_message(query.payload)[1]["version"])
        query.reply(wire.encode_weights(versions[requested[-1]]))

    learner.serve(KEYS.weights_latest, answer)
    policy = WeightCache(hub(), KEYS, untrained(small_run), 1 << 20)
    for version in (6, 2, 6, 0, 1, 3, 2, 6):
        assert policy.at(version)[1] == versions[version].digest
    assert requested == [6, 2, 0, 1, 3, 6]


def test_the_policy_waits_a_limited_time(hub, small_run):
    policy = WeightCache(hub(), KEYS, untrained(small_run), 1 << 20, timeout_s=0.3)
    with pytest.raises(Unanswered, match=r"version 3 did not come within 0.3 s"):
        policy.at(3)
