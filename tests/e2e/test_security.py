"""TLS streams: which clients are accepted, what each role may do, and that a whole run gives the same digests."""

import contextlib
import functools
import json
import shutil
import socket
import ssl

import pytest

from icrl_dist.cli import main
from icrl_dist.stream import endpoints, security
from icrl_dist.stream.link import LinkError, Refused, Unanswered
from icrl_dist.stream.zenoh_link import ZenohLink
from tests import certificates
from tests.contracts.link_battery import eventually
from tests.e2e.intruder import FORBIDDEN, KEYS, OPEN_S, TLS, Scene, answered, listening, read_the_monitor_key
from tests.e2e.training import NO_RESTARTS, SMOKE, endpoint_of, equal, finish, result_of, start


@pytest.fixture(scope="module")
def certified(tmp_path_factory):
    return certificates.make(tmp_path_factory.mktemp("certified"))


@pytest.fixture(scope="module")
def foreign(tmp_path_factory):
    return certificates.make(tmp_path_factory.mktemp("foreign"))


def accepted(link, settings, timeout_s=OPEN_S):
    """Whether the learner accepts a client with these settings and answers it."""
    try:
        with ZenohLink.connect(link.endpoints[0], timeout_s, settings) as client:
            return client.request(KEYS.work, b"", timeout_s=5.0) == b"work"
    except LinkError as error:
        assert "cannot connect to tls/" in str(error)
        return False


def is_refused(link, settings):
    return not accepted(link, settings, 1.5)


def test_only_a_certificate_of_the_same_authority_is_accepted(certified, foreign, tmp_path):
    right, wrong = security.client(certified, "worker"), security.client(foreign, "worker")
    expired = security.client(certificates.make(shutil.copytree(certified, tmp_path / "expired"), days=-1), "worker")
    with listening(certified) as link:
        assert accepted(link, right)
        assert is_refused(link, {}), "no certificate, no authority"
        assert is_refused(link, {TLS + "root_ca_certificate": right[TLS + "root_ca_certificate"]}), "no certificate"
        assert is_refused(link, wrong), "another authority on both sides"
        wrong[TLS + "root_ca_certificate"] = right[TLS + "root_ca_certificate"]
        assert is_refused(link, wrong), "a certificate of another authority"
        assert is_refused(link, expired), "an expired certificate"
        unencrypted = link.endpoints[0].replace("tls/", "tcp/")
        with pytest.raises(LinkError, match="cannot connect"):
            ZenohLink.connect(unencrypted, 1.5).close()
        assert accepted(link, right), "the valid one is still accepted"
        rotated = certificates.make(shutil.copytree(certified, tmp_path / "rotated"))
        assert accepted(link, security.client(rotated, "worker")), "a new certificate, before the learner's is replaced"
    with listening(rotated) as link:
        assert accepted(link, right), "an old one, after it"


def test_the_learner_speaks_tls_1_3_only(certified):
    with listening(certified) as link:
        place = ("127.0.0.1", endpoints.parse(link.endpoints[0]).port)
        for version, spoken in ((ssl.TLSVersion.TLSv1_3, True), (ssl.TLSVersion.TLSv1_2, False)):
            context = ssl.create_default_context(cafile=f"{certified}/ca.pem")
            context.load_cert_chain(f"{certified}/worker.pem", f"{certified}/worker.key")
            context.minimum_version = context.maximum_version = version
            with socket.create_connection(place, timeout=OPEN_S) as plain:
                if spoken:
                    with context.wrap_socket(plain, server_hostname="127.0.0.1") as encrypted:
                        assert encrypted.version() == "TLSv1.3"
                else:
                    with pytest.raises(ssl.SSLError):
                        context.wrap_socket(plain, server_hostname="127.0.0.1")


def test_a_worker_accepts_only_the_learners_certificate(certified, foreign, tmp_path):
    right = security.client(certified, "worker")
    with listening(foreign) as impostor:
        foreign_client = {**right, TLS + "root_ca_certificate": security.files(foreign, "worker")[0]}
        foreign_client |= {
            TLS + f"connect_{k}": security.client(foreign, "worker")[TLS + f"connect_{k}"]
            for k in ("certificate", "private_key")
        }
        assert accepted(impostor, foreign_client)
        assert is_refused(impostor, right), "the learner of another authority"
    settings = security.learner(certified, KEYS.run)
    settings[TLS + "listen_certificate"], settings[TLS + "listen_private_key"] = security.files(certified, "worker")[1:]
    with ZenohLink.listen("tls/127.0.0.1:0", settings) as impostor:
        assert is_refused(impostor, right), "a worker's certificate on the learner's side"
    with listening(certified, endpoint="tls/127.0.0.2:0") as elsewhere:
        assert is_refused(elsewhere, right), "an address that the learner's certificate does not name"
    named = certificates.make(shutil.copytree(certified, tmp_path / "named"), "127.0.0.2")
    with listening(named, endpoint="tls/127.0.0.2:0") as elsewhere:
        assert accepted(elsewhere, right)


def test_each_role_may_do_what_it_needs(certified):
    received, alive, weights = [], [], []
    with contextlib.ExitStack() as stack:
        learner = stack.enter_context(listening(certified))
        learner.watch(KEYS.alive_all, lambda name, present: alive.append((name, present)))
        learner.serve(KEYS.weights_latest, lambda query: query.refuse("busy: none yet"))
        connect = learner.endpoints[0], OPEN_S
        worker = stack.enter_context(ZenohLink.connect(*connect, security.client(certified, "worker")))
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
        )  # the request may precede the declaration
        worker.publish(KEYS.monitor("trajectories/w0"), b"no subscriber", droppable=True)
        monitor = stack.enter_context(ZenohLink.connect(*connect, security.client(certified, "monitor")))
        monitor.subscribe("icrl/*/mon/trajectories/**", lambda key, payload: received.append((key, payload)))
        for link, topic in ((worker, "trajectories/w0"), (learner, "trajectories/learner")):
            eventually(functools.partial(published, link, KEYS.monitor(topic), b"look", received), OPEN_S)
        assert worker.has_subscribers(KEYS.monitor("trajectories/w0")) and not worker.has_subscribers(KEYS.monitor("belief/w0"))
        monitor.subscribe("icrl/*/mon/**", lambda key, payload: None)
        eventually(lambda: worker.has_subscribers(KEYS.monitor("belief/w0")), OPEN_S)
        learner.serve(KEYS.past, lambda query: query.reply(b"past of " + query.payload))
        eventually(lambda: answered(monitor, KEYS.past, b"rounds") == b"past of rounds", OPEN_S)
        eventually(lambda: published(learner, KEYS.weights, b"T^1", weights), OPEN_S)
        eventually(lambda: alive == [("w0", True)], OPEN_S)
        assert (KEYS.monitor("trajectories/w0"), b"look") in received and b"T^1" in weights
        worker.close()
        eventually(lambda: alive == [("w0", True), ("w0", False)], OPEN_S)


def published(link, key, payload, received):
    """Publish once; whether the message has been received yet."""
    link.publish(key, payload, droppable=True)
    return any(payload == item or item == (key, payload) for item in received)


@pytest.mark.parametrize(("role", "action"), FORBIDDEN, ids=lambda value: value if isinstance(value, str) else value.__name__)
def test_a_forbidden_action_works_without_the_rules_and_fails_with_them(certified, role, action):
    for rules in (False, True):
        with contextlib.ExitStack() as stack:
            scene = Scene(stack, certified, role, rules)
            assert action(scene) is not rules, f"{role}: {action.__name__} with rules {'on' if rules else 'off'}"
            scene.received.clear()
            scene.wait_s = OPEN_S
            if role == "worker":  # the connection still works, so the rules were the cause
                scene.request(KEYS.work)
            else:
                read_the_monitor_key(scene)
            assert scene.received


@pytest.mark.usefixtures("no_ray_token")
def test_an_unencrypted_endpoint_of_another_node_is_refused(capsys, tmp_path, certified):
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
    away = ["--stream.endpoint", "tls/10.0.0.1:7447", "--stream.certificates", certified, "--address", "head:6379"]
    assert "RAY_AUTH_MODE=token" in refused(*away)


def test_a_tap_without_certificates_is_refused_with_the_remedy(capsys, certified):
    assert main.main(["tap", "--connect", "tls/127.0.0.1:1"]) == 2
    assert "--certificates" in capsys.readouterr().err
    with listening(certified) as link:
        assert main.main(["tap", "--connect", link.endpoints[0], "--certificates", certified + "/none"]) == 2
    assert "none/ca.pem: cannot be read" in capsys.readouterr().err


def test_a_run_with_tls_and_four_workers_has_the_digests_of_one_process(certified, reference, tmp_path):
    folder = tmp_path / "secure"
    tls = ["--actors", "4", "--oversubscribe", "--stream.endpoint", "tls/127.0.0.1:0", "--stream.certificates", certified]
    with contextlib.ExitStack() as stack:
        run = stack.enter_context(start("train", *SMOKE, *NO_RESTARTS, *tls, "--out", folder))
        stack.callback(run.terminate)
        assert endpoint_of(folder).startswith("tls/")
        tap = stack.enter_context(start("tap", folder, "--count", "1"))
        stack.callback(tap.terminate)
        output = finish(run)
        assert run.returncode == 0, output
        tap.terminate()  # the run is over, so no further message will come
        line = finish(tap, timeout=60)
        assert json.loads(line)["identity"], "the tap has used the run's monitor certificate"
    assert equal(result_of(folder), reference)
    assert result_of(folder)["lag"].keys() == {"0"}
