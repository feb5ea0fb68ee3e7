"""Actions that a role may not take on a learner's streams, and the scene in which an intruder tries them."""

import contextlib
import json
import time

import zenoh

from icrl_dist.stream import security
from icrl_dist.stream.link import StreamKeys, Unanswered
from icrl_dist.stream.zenoh_link import ZenohLink

KEYS = StreamKeys("run")
TLS = "transport/link/tls/"
OPEN_S, SHUT_S = 20.0, 0.5
"""Seconds to wait for an event that must happen, and for one that must not."""


@contextlib.contextmanager
def listening(folder, rules=True, endpoint="tls/127.0.0.1:0"):
    """A learner that answers requests for work; without ``rules`` it has TLS but no access rules."""
    settings = security.learner(folder, KEYS.run)
    if not rules:
        del settings["access_control"]
    with ZenohLink.listen(endpoint, settings) as link:
        link.serve(KEYS.work, lambda query: query.reply(b"work"))
        yield link


def answered(link, key, payload=b""):
    with contextlib.suppress(Unanswered):
        return link.request(key, payload, timeout_s=1.0)


class Scene:
    """A learner, a worker, a monitor, and an intruder: a Zenoh session with a valid certificate and no restraint."""

    def __init__(self, stack, folder, role, rules):
        self.learner = stack.enter_context(listening(folder, rules))
        where = self.learner.endpoints[0]
        self.worker = stack.enter_context(ZenohLink.connect(where, OPEN_S, security.client(folder, "worker")))
        self.monitor = stack.enter_context(ZenohLink.connect(where, OPEN_S, security.client(folder, "monitor")))
        config = zenoh.Config()
        base = {"mode": "client", "connect/endpoints": [where], "scouting/multicast/enabled": False}
        for key, value in {**base, **security.client(folder, role)}.items():
            config.insert_json5(key, json.dumps(value))
        self.intruder = stack.enter_context(zenoh.open(config))
        self.received = []
        self.wait_s = SHUT_S if rules else OPEN_S

    def record(self, *what):
        self.received.append(what)

    def succeeds(self, attempt=lambda: None):
        """Whether the attempt, repeated for ``wait_s``, had an effect that was recorded."""
        end = time.monotonic() + self.wait_s
        while not self.received and time.monotonic() < end:
            attempt()
            time.sleep(0.02)
        return bool(self.received)

    def subscribe(self, key_expr):
        self.intruder.declare_subscriber(key_expr, lambda sample: self.record(str(sample.key_expr)))

    def serve(self, key):
        def answer(query):
            self.record(query.payload.to_bytes())
            query.reply(key, b"forged")
            query.drop()

        self.intruder.declare_queryable(key, answer, complete=True)

    def request(self, key):
        for reply in self.intruder.get(key, payload=b"let me", timeout=1.0):
            self.record(reply)


def forge_weights(scene):
    scene.worker.subscribe(KEYS.weights, scene.record)
    return scene.succeeds(lambda: scene.intruder.put(KEYS.weights, b"forged"))


def delete_weights(scene):
    scene.worker.subscribe(KEYS.weights, scene.record)
    return scene.succeeds(lambda: scene.intruder.delete(KEYS.weights))


def forge_the_monitor_key(scene):
    scene.monitor.subscribe(KEYS.monitor_all, scene.record)
    return scene.succeeds(lambda: scene.intruder.put(KEYS.monitor("learner"), b"forged"))


def delete_the_monitor_key(scene):
    scene.monitor.subscribe(KEYS.monitor_all, scene.record)
    return scene.succeeds(lambda: scene.intruder.delete(KEYS.monitor("worker/w0")))


def forge_a_heartbeat(scene):
    scene.learner.subscribe(KEYS.heartbeats, scene.record)
    return scene.succeeds(lambda: scene.intruder.put(KEYS.monitor("worker/w0"), b"forged"))


def forge_another_run(scene):
    scene.monitor.subscribe("icrl/*/mon/**", scene.record)
    return scene.succeeds(lambda: scene.intruder.put(StreamKeys("other").monitor("learner"), b"forged"))


def read_the_data_of_others(scene):
    scene.serve(KEYS.data)
    return scene.succeeds(lambda: answered(scene.worker, KEYS.data, b"secret"))


def serve_the_weights(scene):
    scene.serve(KEYS.weights_latest)
    return scene.succeeds(lambda: answered(scene.worker, KEYS.weights_latest))


def serve_everything(scene):
    scene.serve("**")
    return scene.succeeds(lambda: answered(scene.worker, KEYS.weights_latest))


def read_the_weights(scene):
    scene.subscribe(KEYS.weights)
    return scene.succeeds(lambda: scene.learner.publish(KEYS.weights, b"T^1", droppable=False))


def read_everything(scene):
    scene.subscribe("**")
    return scene.succeeds(lambda: scene.learner.publish(KEYS.weights, b"T^1", droppable=False))


def read_the_monitor_key(scene):
    scene.subscribe(KEYS.monitor_all)
    return scene.succeeds(lambda: scene.learner.publish(KEYS.monitor("learner"), b"look", droppable=True))


def ask_for_work(scene):
    return scene.succeeds(lambda: scene.request(KEYS.work))


def send_data(scene):
    scene.learner.serve(KEYS.data, lambda query: query.reply(b"stored"))
    return scene.succeeds(lambda: scene.request(KEYS.data))


def ask_for_the_weights(scene):
    scene.learner.serve(KEYS.weights_latest, lambda query: query.reply(b"T^1"))
    return scene.succeeds(lambda: scene.request(KEYS.weights_latest))


def ask_for_the_past(scene):
    scene.learner.serve(KEYS.past, lambda query: query.reply(b"returns"))
    return scene.succeeds(lambda: scene.request(KEYS.past))


def serve_the_past(scene):
    scene.serve(KEYS.past)
    return scene.succeeds(lambda: answered(scene.monitor, KEYS.past))


def ask_for_anything(scene):
    return scene.succeeds(lambda: scene.request("**"))


def pose_as_a_worker(scene):
    scene.learner.watch(KEYS.alive_all, scene.record)
    token = scene.intruder.liveliness().declare_token(KEYS.alive("intruder"))
    succeeded = scene.succeeds()
    token.undeclare()
    return succeeded


def watch_the_workers(scene):
    scene.worker.announce(KEYS.alive("w0"))
    scene.intruder.liveliness().declare_subscriber(
        KEYS.alive_all, lambda sample: scene.record(str(sample.key_expr)), history=True
    )
    return scene.succeeds()


def list_the_workers(scene):
    scene.worker.announce(KEYS.alive("w0"))

    def look():
        for reply in scene.intruder.liveliness().get(KEYS.alive_all, timeout=0.2):
            scene.record(reply)

    return scene.succeeds(look)


BOTH_ROLES = [forge_weights, delete_weights, read_the_data_of_others, serve_the_weights, serve_everything, read_everything]
BOTH_ROLES += [serve_the_past, ask_for_anything, forge_another_run, watch_the_workers, list_the_workers]
BOTH_ROLES += [forge_the_monitor_key, delete_the_monitor_key]
MONITOR_ONLY = [forge_a_heartbeat, read_the_weights, ask_for_work, send_data, ask_for_the_weights, pose_as_a_worker]
FORBIDDEN = [("worker", action) for action in [*BOTH_ROLES, read_the_monitor_key, ask_for_the_past]] + [
    ("monitor", action) for action in [*BOTH_ROLES, *MONITOR_ONLY]
]
