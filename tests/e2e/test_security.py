"""Off this machine: who is let in, what each may do, and that a whole run ends as it does in the clear."""

import contextlib
import json
import shutil
import time

import pytest
import zenoh

from icrl_dist.cli import main
from icrl_dist.stream import security
from icrl_dist.stream.link import LinkError, Refused, StreamKeys, Unanswered
from icrl_dist.stream.zenoh_link import ZenohLink
from tests import certificates
from tests.contracts.link_battery import eventually
from tests.e2e.training import ONE_LIFE, SMOKE, endpoint_of, equal, finish, result_of, start

KEYS = StreamKeys("run")
TLS = "transport/link/tls/"
OPEN_S, SHUT_S = 20.0, 0.5
"""How long to wait for what must happen, and for what must not."""


@pytest.fixture(scope="module")
def ours(tmp_path_factory):
    return certificates.make(tmp_path_factory.mktemp("ours"))


@pytest.fixture(scope="module")
def theirs(tmp_path_factory):
    return certificates.make(tmp_path_factory.mktemp("theirs"))


@contextlib.contextmanager
def listening(folder, rules=True, endpoint="tls/127.0.0.1:0"):
    """A learner that answers work; without ``rules`` TLS is all that guards it."""
    settings = security.learner(folder, KEYS.run)
    if not rules:
        del settings["access_control"]
    with ZenohLink.listen(endpoint, settings) as link:
        link.serve(KEYS.work, lambda query: query.reply(b"work"))
        yield link


def let_in(link, settings, patience_s=OPEN_S):
    """Whether the learner takes a client with these settings and answers it."""
    try:
        with ZenohLink.connect(link.endpoints[0], patience_s, settings) as client:
            return client.request(KEYS.work, b"", timeout_s=5.0) == b"work"
    except LinkError as error:
        assert "cannot connect to tls/" in str(error)
        return False


def shut_out(link, settings):
    return not let_in(link, settings, 1.5)


def test_only_a_certificate_of_the_same_authority_is_let_in(ours, theirs, tmp_path):
    right, wrong = security.client(ours, "worker"), security.client(theirs, "worker")
    late = security.client(certificates.make(shutil.copytree(ours, tmp_path / "late"), days=-1), "worker")
    with listening(ours) as link:
        assert let_in(link, right)
        assert shut_out(link, {}), "no certificate, no authority"
        assert shut_out(link, {TLS + "root_ca_certificate": right[TLS + "root_ca_certificate"]}), "no certificate"
        assert shut_out(link, wrong), "another authority, both ways"
        wrong[TLS + "root_ca_certificate"] = right[TLS + "root_ca_certificate"]
        assert shut_out(link, wrong), "a certificate of another authority"
        assert shut_out(link, late), "one that has expired"
        clear = link.endpoints[0].replace("tls/", "tcp/")
        with pytest.raises(LinkError, match="cannot connect"):
            ZenohLink.connect(clear, 1.5).close()
        assert let_in(link, right), "and still the right one"


def test_a_worker_takes_nobody_else_for_the_learner(ours, theirs, tmp_path):
    right = security.client(ours, "worker")
    with listening(theirs) as impostor:
        blind = {**right, TLS + "root_ca_certificate": security.files(theirs, "worker")[0]}
        blind |= {
            TLS + f"connect_{k}": security.client(theirs, "worker")[TLS + f"connect_{k}"]
            for k in ("certificate", "private_key")
        }
        assert let_in(impostor, blind)
        assert shut_out(impostor, right), "the learner of another authority"
    settings = security.learner(ours, KEYS.run)
    settings[TLS + "listen_certificate"], settings[TLS + "listen_private_key"] = security.files(ours, "worker")[1:]
    with ZenohLink.listen("tls/127.0.0.1:0", settings) as impostor:
        assert shut_out(impostor, right), "another worker, with its own certificate"
    with listening(ours, endpoint="tls/127.0.0.2:0") as elsewhere:
        assert shut_out(elsewhere, right), "a host that the learner's certificate does not name"
    named = certificates.make(shutil.copytree(ours, tmp_path / "named"), "127.0.0.2")
    with listening(named, endpoint="tls/127.0.0.2:0") as elsewhere:
        assert let_in(elsewhere, right)


def test_a_worker_and_a_monitor_do_their_work(ours):
    heard, alive, weights = [], [], []
    with contextlib.ExitStack() as stack:
        learner = stack.enter_context(listening(ours))
        learner.watch(KEYS.alive_all, lambda name, there: alive.append((name, there)))
        learner.serve(KEYS.weights_latest, lambda query: query.refuse("busy: none yet"))
        connect = learner.endpoints[0], OPEN_S
        worker = stack.enter_context(ZenohLink.connect(*connect, security.client(ours, "worker")))
        worker.announce(KEYS.alive("w0"))
        worker.subscribe(KEYS.weights, lambda _, payload: weights.append(payload))
        assert worker.request(KEYS.work, b"", timeout_s=5.0) == b"work"
        with pytest.raises(Refused, match="busy: none yet"):
            worker.request(KEYS.weights_latest, b"", timeout_s=5.0)
        with pytest.raises(Unanswered):
            worker.request(KEYS.data, b"trajectory", timeout_s=5.0)
        learner.serve(KEYS.data, lambda query: query.reply(b"stored " + query.payload))
        eventually(
            lambda: answered(worker, KEYS.data, b"trajectory") == b"stored trajectory", OPEN_S
        )  # asked before it was served
        worker.publish(KEYS.monitor("trajectories/w0"), b"nobody listens", droppable=True)
        monitor = stack.enter_context(ZenohLink.connect(*connect, security.client(ours, "monitor")))
        monitor.subscribe("icrl/*/mon/trajectories/**", lambda key, payload: heard.append((key, payload)))
        for link, topic in ((worker, "trajectories/w0"), (learner, "trajectories/learner")):
            eventually(lambda link=link, topic=topic: published(link, KEYS.monitor(topic), b"look", heard), OPEN_S)
        assert worker.has_subscribers(KEYS.monitor("trajectories/w0")) and not worker.watched(KEYS.monitor("belief/w0"))
        monitor.subscribe("icrl/*/mon/**", lambda key, payload: None)
        eventually(lambda: worker.has_subscribers(KEYS.monitor("belief/w0")), OPEN_S)
        eventually(lambda: published(learner, KEYS.weights, b"T^1", weights), OPEN_S)
        eventually(lambda: alive == [("w0", True)], OPEN_S)
        assert (KEYS.monitor("trajectories/w0"), b"look") in heard and b"T^1" in weights
        worker.close()
        eventually(lambda: alive == [("w0", True), ("w0", False)], OPEN_S)


def answered(link, key, payload=b""):
    with contextlib.suppress(Unanswered):
        return link.request(key, payload, timeout_s=1.0)


def published(link, key, payload, heard):
    """Say it again until it is heard."""
    link.publish(key, payload, droppable=True)
    return any(payload == item or item == (key, payload) for item in heard)


class Scene:
    """A learner, an honest worker and monitor, and an intruder with a certificate of ours who asks nobody."""

    def __init__(self, stack, folder, role, rules):
        self.learner = stack.enter_context(listening(folder, rules))
        where = self.learner.endpoints[0]
        self.worker = stack.enter_context(ZenohLink.connect(where, OPEN_S, security.client(folder, "worker")))
        self.monitor = stack.enter_context(ZenohLink.connect(where, OPEN_S, security.client(folder, "monitor")))
        config = zenoh.Config()
        plain = {"mode": "client", "connect/endpoints": [where], "scouting/multicast/enabled": False}
        for key, value in {**plain, **security.client(folder, role)}.items():
            config.insert_json5(key, json.dumps(value))
        self.intruder = stack.enter_context(zenoh.open(config))
        self.heard = []
        self.patience_s = SHUT_S if rules else OPEN_S

    def tell(self, *what):
        self.heard.append(what)

    def gained(self, attempt=lambda: None):
        """Whether anything was heard that should not have been, trying until patience ends."""
        end = time.monotonic() + self.patience_s
        while not self.heard and time.monotonic() < end:
            attempt()
            time.sleep(0.02)
        return bool(self.heard)

    def listens(self, key_expr):
        self.intruder.declare_subscriber(key_expr, lambda sample: self.tell(str(sample.key_expr)))

    def serves(self, key):
        def answer(query):
            self.tell(query.payload.to_bytes())
            query.reply(key, b"forged")
            query.drop()

        self.intruder.declare_queryable(key, answer, complete=True)

    def asks(self, key):
        for reply in self.intruder.get(key, payload=b"let me", timeout=1.0):
            self.tell(reply)


def forge_weights(scene):
    scene.worker.subscribe(KEYS.weights, scene.tell)
    return scene.gained(lambda: scene.intruder.put(KEYS.weights, b"forged"))


def delete_weights(scene):
    scene.worker.subscribe(KEYS.weights, scene.tell)
    return scene.gained(lambda: scene.intruder.delete(KEYS.weights))


def forge_the_monitor_key(scene):
    scene.monitor.subscribe(KEYS.monitor_all, scene.tell)
    return scene.gained(lambda: scene.intruder.put(KEYS.monitor("learner"), b"forged"))


def speak_for_another_run(scene):
    scene.monitor.subscribe("icrl/*/mon/**", scene.tell)
    return scene.gained(lambda: scene.intruder.put(StreamKeys("other").monitor("learner"), b"forged"))


def read_the_data_of_others(scene):
    scene.serves(KEYS.data)
    return scene.gained(lambda: answered(scene.worker, KEYS.data, b"secret"))


def serve_the_weights(scene):
    scene.serves(KEYS.weights_latest)
    return scene.gained(lambda: answered(scene.worker, KEYS.weights_latest))


def serve_everything(scene):
    scene.serves("**")
    return scene.gained(lambda: answered(scene.worker, KEYS.weights_latest))


def read_the_weights(scene):
    scene.listens(KEYS.weights)
    return scene.gained(lambda: scene.learner.publish(KEYS.weights, b"T^1", droppable=False))


def read_everything(scene):
    scene.listens("**")
    return scene.gained(lambda: scene.learner.publish(KEYS.weights, b"T^1", droppable=False))


def read_the_monitor_key(scene):
    scene.listens(KEYS.monitor_all)
    return scene.gained(lambda: scene.learner.publish(KEYS.monitor("learner"), b"look", droppable=True))


def ask_for_work(scene):
    return scene.gained(lambda: scene.asks(KEYS.work))


def send_data(scene):
    scene.learner.serve(KEYS.data, lambda query: query.reply(b"stored"))
    return scene.gained(lambda: scene.asks(KEYS.data))


def ask_for_the_weights(scene):
    scene.learner.serve(KEYS.weights_latest, lambda query: query.reply(b"T^1"))
    return scene.gained(lambda: scene.asks(KEYS.weights_latest))


def ask_for_anything(scene):
    return scene.gained(lambda: scene.asks("**"))


def pose_as_a_worker(scene):
    scene.learner.watch(KEYS.alive_all, scene.tell)
    token = scene.intruder.liveliness().declare_token(KEYS.alive("intruder"))
    gained = scene.gained()
    token.undeclare()
    return gained


def watch_the_workers(scene):
    scene.worker.announce(KEYS.alive("w0"))
    scene.intruder.liveliness().declare_subscriber(
        KEYS.alive_all, lambda sample: scene.tell(str(sample.key_expr)), history=True
    )
    return scene.gained()


def list_the_workers(scene):
    scene.worker.announce(KEYS.alive("w0"))

    def look():
        for reply in scene.intruder.liveliness().get(KEYS.alive_all, timeout=0.2):
            scene.tell(reply)

    return scene.gained(look)


ANYONE = [forge_weights, delete_weights, read_the_data_of_others, serve_the_weights, serve_everything, read_everything]
ANYONE += [ask_for_anything, speak_for_another_run, watch_the_workers, list_the_workers]
MONITORS = [forge_the_monitor_key, read_the_weights, ask_for_work, send_data, ask_for_the_weights, pose_as_a_worker]
MISDEEDS = [("worker", deed) for deed in [*ANYONE, read_the_monitor_key]] + [("monitor", deed) for deed in [*ANYONE, *MONITORS]]


@pytest.mark.parametrize(("role", "deed"), MISDEEDS, ids=lambda value: value if isinstance(value, str) else value.__name__)
def test_what_a_role_may_not_do_works_without_the_rules_and_not_with_them(ours, role, deed):
    for rules in (False, True):
        with contextlib.ExitStack() as stack:
            scene = Scene(stack, ours, role, rules)
            assert deed(scene) is not rules, f"{role}: {deed.__name__} with rules {'on' if rules else 'off'}"
            scene.heard.clear()
            scene.patience_s = OPEN_S
            if role == "worker":  # it was the rules, and no broken line
                scene.asks(KEYS.work)
            else:
                read_the_monitor_key(scene)
            assert scene.heard


@pytest.mark.usefixtures("no_ray_token")
def test_off_this_machine_in_the_clear_is_refused(capsys, tmp_path, ours):
    def refused(*arguments):
        assert main.main(["train", "smoke", "--actors", "1", "--out", str(tmp_path / "out"), *arguments]) == 2
        (line,) = capsys.readouterr().err.strip().splitlines()
        assert not (tmp_path / "out").exists()
        return line

    line = refused("--stream.endpoint", "tcp/0.0.0.0:7447")
    assert "stream.endpoint = 'tcp/0.0.0.0:7447'" in line
    assert "tls/HOST:PORT" in line and "stream.certificates" in line and "docs/security.md" in line
    tls = ["--stream.endpoint", "tls/127.0.0.1:0", "--stream.certificates"]
    assert "no/such/ca.pem: cannot be read" in refused(*tls, "no/such")
    away = ["--stream.endpoint", "tls/10.0.0.1:7447", "--stream.certificates", ours, "--address", "head:6379"]
    assert "RAY_AUTH_MODE=token" in refused(*away)


def test_a_tap_without_its_certificates_is_told_what_it_needs(capsys, ours):
    assert main.main(["tap", "--connect", "tls/127.0.0.1:1"]) == 2
    assert "--certificates" in capsys.readouterr().err
    with listening(ours) as link:
        assert main.main(["tap", "--connect", link.endpoints[0], "--certificates", ours + "/none"]) == 2
    assert "none/ca.pem: cannot be read" in capsys.readouterr().err


def test_a_whole_run_of_one_worker_by_tls_ends_with_the_bytes_of_none(ours, reference, tmp_path):
    folder = tmp_path / "secure"
    tls = ["--actors", "1", "--stream.endpoint", "tls/127.0.0.1:0", "--stream.certificates", ours]
    with contextlib.ExitStack() as stack:
        run = stack.enter_context(start("train", *SMOKE, *ONE_LIFE, *tls, "--out", folder))
        stack.callback(run.terminate)
        assert endpoint_of(folder).startswith("tls/")
        tap = stack.enter_context(start("tap", folder, "--count", "1"))
        stack.callback(tap.terminate)
        output = finish(run)
        assert run.returncode == 0, output
        tap.terminate()  # the run is over: what it has not heard by now it never will
        line = finish(tap, timeout=60)
        assert json.loads(line)["identity"], "the tap shows the run's own certificates, those of a monitor"
    assert equal(result_of(folder), reference)
    assert result_of(folder)["lag"].keys() == {"0"}
