"""A worker against a scripted learner on a MemoryLink."""

import dataclasses
import json
import threading

import numpy as np
import pytest
import torch

import icrl_dist
from actors import worker as worker_module
from actors.policy import LivePolicy
from actors.watchdog import Watchdog
from actors.worker import Samples, Worker
from icrl_dist import jobs
from icrl_dist.config import dumps
from icrl_dist.envs import spec, tasks
from icrl_dist.models.dpt import PretrainedTransformer, weights_of
from icrl_dist.recipes import METHODS
from icrl_dist.stream import batch, wire
from icrl_dist.stream.link import Keys, Refused, Unanswered
from icrl_dist.types import Identity, Weights

KEYS = Keys("test")


def weights(run, version):
    torch.manual_seed(version)
    arrays = weights_of(PretrainedTransformer(spec(tasks.split(run).train[0]), run.model))
    return Weights(version, arrays, wire.weights_digest(arrays))


class Learner:
    """Hands out a list of answers, keeps what arrives."""

    def __init__(self, link, run, answers):
        self.run, self.answers, self.asked, self.stored = run, list(answers), [], []
        self.refused = set()
        link.serve(KEYS.work, self.work)
        link.serve(KEYS.data, self.data)

    def work(self, query):
        kind, fields = wire.decode_message(query.payload)
        self.asked.append((kind, fields))
        if kind == "hello":
            query.reply(wire.encode_message("hello", run=dumps(self.run)))
        elif kind == "failed":
            query.reply(wire.encode_message("noted"))
        else:
            query.reply(self.answers.pop(0))

    def data(self, query):
        for one in batch.split(query, 1 << 20):
            trajectory = wire.decode_trajectory(one.payload, 1 << 20)
            if trajectory.identity in self.refused:
                one.refuse(f"not-finite: {trajectory.identity}: a value is infinite")
            else:
                self.stored.append(trajectory)
                one.reply(b"stored")


def job_message(job):
    return wire.encode_message("job", job=wire.encode_job(job), deadline_s=60.0)


STOP = wire.encode_message("stop")


def test_a_worker_does_its_job_says_who_it_is_and_stops(hub, small_run):
    job = METHODS["icag"].ask(small_run, METHODS["icag"].phases(small_run)[0])[2]
    learner = Learner(hub(), small_run, [wire.encode_message("wait", seconds=0.01), job_message(job), STOP])
    seen = []
    watching = hub()
    watching.subscribe(KEYS.monitor_all, lambda key, payload: seen.append(wire.decode_message(payload)))
    Worker(hub(), "test", "w7").run()
    assert [t.identity for t in learner.stored] == list(job.identities())
    assert {t.worker for t in learner.stored} == {"w7"}
    assert learner.asked[0][1]["version"] == icrl_dist.__version__
    assert [kind for kind, _ in learner.asked] == ["hello", "ask", "ask", "ask"]
    monitored = [fields["identity"] for kind, fields in seen if kind == "trajectory"]
    assert monitored == [str(i) for i in job.identities()][: len(monitored)] and monitored


def test_a_job_that_raises_is_reported_and_the_worker_goes_on(hub, small_run):
    phase = METHODS["icag"].phases(small_run)[0]
    good, other = METHODS["icag"].ask(small_run, phase)[:2]
    bad = dataclasses.replace(other, settings=())
    learner = Learner(hub(), small_run, [job_message(bad), job_message(good), STOP])
    Worker(hub(), "test", "w0").run()
    (report,) = [fields for kind, fields in learner.asked if kind == "failed"]
    assert report["job"] == list(bad.name) and report["file"] == ""
    record = report["record"]
    assert "KeyError" in record["exception"] and ".py:" in record["exception"]
    first = next(iter(bad.identities()))
    assert (record["identity"], record["seed"], record["spawn_key"]) == (str(first), bad.seed, list(first.key()))
    assert record["job"] == bad.label and record["worker"] == "w0" and record["variations"] == len(bad.variations)
    assert 10 < record["memory_mb"] <= record["peak_mb"]
    assert "Traceback" in record["traceback"] and "jobs.py" in record["traceback"]
    assert len(learner.stored) == len(list(good.identities()))


def test_the_record_names_the_trajectory_that_was_under_way(hub, small_run, monkeypatch, tmp_path):
    job = METHODS["icag"].ask(small_run, METHODS["icag"].phases(small_run)[0])[0]
    real = jobs.do

    def breaks_at_the_third(job, policies, worker, tell):
        work = real(job, policies, worker)
        yield next(work)
        yield next(work)
        raise ZeroDivisionError("\udcff the room broke")

    monkeypatch.setattr(jobs, "do", breaks_at_the_third)
    learner = Learner(hub(), small_run, [job_message(job), STOP])
    monkeypatch.setattr(worker_module, "Watchdog", lambda run, name: Watchdog(None, name))  # pytest's process has one
    monkeypatch.setattr(worker_module._log, "exception", lambda *words: None)  # not every log can hold such words
    Worker(hub(), "test", "w3", folder=tmp_path).run()
    (report,) = [fields for kind, fields in learner.asked if kind == "failed"]
    assert [t.identity for t in learner.stored] == list(job.identities())[:2]
    assert report["record"]["identity"] == str(list(job.identities())[2])
    assert report["file"] == "w3-1.json"
    assert json.loads((tmp_path / "crashes" / "w3-1.json").read_text()) == report["record"]


def test_a_refused_trajectory_fails_its_own_job_and_no_other(hub, small_run):
    bad, good = METHODS["icag"].ask(small_run, METHODS["icag"].phases(small_run)[0])[:2]
    learner = Learner(hub(), small_run, [job_message(bad), job_message(good), STOP])
    learner.refused = set(list(bad.identities())[:5])
    Worker(hub(), "test", "w0").run()
    (report,) = [fields for kind, fields in learner.asked if kind == "failed"]
    assert report["job"] == list(bad.name)
    assert "Refused: not-finite: pretrain/0/0/0/0" in report["record"]["exception"] and report["record"]["identity"] == ""
    assert {t.identity for t in learner.stored} >= set(good.identities())


def test_every_ask_says_what_was_done_and_heartbeats_go_on_meanwhile(hub, small_run, monkeypatch):
    monkeypatch.setattr(worker_module, "HEARTBEAT_S", 0.01)
    job = METHODS["icag"].ask(small_run, METHODS["icag"].phases(small_run)[0])[0]
    heard = []
    beaten = threading.Event()
    watching = hub()

    def hear(_, payload):
        heard.append(wire.decode_message(payload))
        if sum(fields["job"] == job.label for _, fields in heard) == 3:
            beaten.set()

    watching.subscribe(KEYS.heartbeats, hear)
    real = jobs.do

    def stuck_for_three_beats(job, policies, worker, tell):
        assert beaten.wait(30)
        return real(job, policies, worker)

    monkeypatch.setattr(jobs, "do", stuck_for_three_beats)
    learner = Learner(hub(), small_run, [job_message(job), STOP])
    Worker(hub(), "test", "w0").run()
    asks = [fields for kind, fields in learner.asked if kind == "ask"]
    count = len(list(job.identities()))
    said = [{name: ask[name] for name in ("episodes", "steps", "trajectories", "resent")} for ask in asks]
    assert said[0] == dict.fromkeys(said[0], 0)
    assert said[1] == {"episodes": count, "steps": count * small_run.darkroom.horizon, "trajectories": count, "resent": 0}
    assert {kind for kind, _ in heard} == {"worker"}
    assert all(fields["worker"] == "w0" and fields["memory_mb"] > 10 for _, fields in heard)


def test_a_refused_hello_ends_the_worker_with_the_reason(hub):
    hub().serve(KEYS.work, lambda query: query.refuse("schema: worker runs another version"))
    with pytest.raises(Refused, match="another version"):
        Worker(hub(), "test", "w0").run()


def test_a_worker_gives_up_when_the_learner_stays_away(hub):
    with pytest.raises(Unanswered):
        Worker(hub(), "test", "w0", patience_s=0.3).run()


def test_the_policy_waits_for_exactly_the_version_that_is_named(hub, small_run):
    learner = hub()
    latest = [b""]
    learner.serve(KEYS.weights_latest, lambda q: q.reply(latest[0]) if latest[0] else q.refuse("busy"))
    policy = LivePolicy(hub(), KEYS, spec(tasks.split(small_run).train[0]), small_run.model, 1 << 20, timeout_s=5.0)
    zero, one = weights(small_run, 0), weights(small_run, 1)
    threading.Timer(0.3, lambda: learner.publish(KEYS.weights, wire.encode_weights(zero), droppable=False)).start()
    model, digest = policy.at(0)
    assert digest == zero.digest
    np.testing.assert_array_equal(weights_of(model)["head.weight"], zero.arrays["head.weight"])
    latest[0] = wire.encode_weights(one)
    model, digest = policy.at(1)
    assert digest == one.digest
    np.testing.assert_array_equal(weights_of(model)["head.weight"], one.arrays["head.weight"])
    assert policy.at(0)[1] == zero.digest, "a job of an earlier round that is done again"
    with pytest.raises(Unanswered, match="version 0 is gone; the learner is at 1"):
        LivePolicy(hub(), KEYS, spec(tasks.split(small_run).train[0]), small_run.model, 1 << 20).at(0)


def test_the_policy_asks_for_an_older_version_by_its_number_and_forgets_the_oldest(hub, small_run):
    learner = hub()
    versions = [weights(small_run, v) for v in range(7)]
    asked = []

    def answer(query):
        asked.append(wire.decode_message(query.payload)[1]["version"])
        query.reply(wire.encode_weights(versions[asked[-1]]))

    learner.serve(KEYS.weights_latest, answer)
    policy = LivePolicy(hub(), KEYS, spec(tasks.split(small_run).train[0]), small_run.model, 1 << 20)
    for version in (6, 2, 6, 0, 1, 3, 2, 6):
        assert policy.at(version)[1] == versions[version].digest
    assert asked == [6, 2, 0, 1, 3, 6]


def test_the_policy_does_not_wait_for_ever(hub, small_run):
    policy = LivePolicy(hub(), KEYS, spec(tasks.split(small_run).train[0]), small_run.model, 1 << 20, timeout_s=0.3)
    with pytest.raises(Unanswered, match=r"version 3 did not come within 0.3 s"):
        policy.at(3)


def test_shown_episodes_are_few_and_every_variation_has_its_turn():
    samples, shown = Samples(per_s=4.0, burst=8, again_s=2.0), []
    for trial in range(60):  # 30 variations end an episode together, four times a second
        now = 0.25 * trial
        shown += [v for v in range(30) if samples.take(Identity("adapt", 0, 0, v, trial), now)]
    assert len(shown) <= 8 + 4 * 15
    assert sorted(shown[:30]) == list(range(30))
    assert len(shown) > 38, "and then the next turn"
