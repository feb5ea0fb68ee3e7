"""Certificates and rules: what the script makes is taken, anything else is named; templates cannot drift."""

import json
import os
import stat
import subprocess

import pytest
import zenoh

from icrl_dist.config.run import ConfigError, Run
from icrl_dist.launch.train import check_security
from icrl_dist.stream import security, zenoh_link
from icrl_dist.stream.link import LinkError
from icrl_dist.stream.zenoh_link import ZenohLink
from tests import certificates

ROLES = ("learner", "worker", "monitor")


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    return certificates.make(tmp_path_factory.mktemp("security") / "certificates", "head.example", "10.0.0.1", "fd00::1")


def about(certificate, *options):
    command = ["openssl", "x509", "-noout", "-in", str(certificate), *options]
    return subprocess.run(command, capture_output=True, text=True, check=True).stdout


def test_the_script_makes_an_authority_and_a_certificate_a_role(tmp_path, made):
    names = sorted(f"{name}.{kind}" for name in ("ca", *ROLES) for kind in ("key", "pem"))
    assert sorted(os.listdir(made)) == names  # noqa: PTH208
    for name in names:
        assert stat.S_IMODE(os.stat(f"{made}/{name}").st_mode) == 0o600, "keys are nobody else's"  # noqa: PTH116
    for role in ROLES:
        assert about(f"{made}/{role}.pem", "-subject").strip().endswith(f"CN = {role}")
        assert security.files(made, role) == tuple(f"{made}/{name}" for name in ("ca.pem", f"{role}.pem", f"{role}.key"))
        usage = about(f"{made}/{role}.pem", "-ext", "extendedKeyUsage")
        assert ("Server" in usage, "Client" in usage) == (role == "learner", role != "learner")
    names = about(f"{made}/learner.pem", "-ext", "subjectAltName")
    for name in ("DNS:localhost", "IP Address:127.0.0.1", "DNS:head.example", "IP Address:10.0.0.1", "IP Address:FD00:0:"):
        assert name in names


def test_the_script_run_again_keeps_the_authority(tmp_path):
    folder = certificates.make(tmp_path)
    before = {f.name: f.read_bytes() for f in tmp_path.iterdir()}
    certificates.make(tmp_path)
    after = {f.name: f.read_bytes() for f in tmp_path.iterdir()}
    assert {name for name in before if before[name] == after[name]} == {"ca.pem", "ca.key"}
    assert security.files(folder, "worker")


def test_without_certificates_nothing_is_set():
    assert security.learner("", "run") == security.client("", "worker") == security.client("", "monitor") == {}


@pytest.mark.parametrize("role", ROLES)
def test_a_file_that_is_missing_or_wrong_is_named_with_the_remedy(tmp_path, role):
    folder = certificates.make(tmp_path)

    def complaint():
        with pytest.raises(LinkError, match=r"certificates\.sh.*docs/security\.md") as caught:
            security.files(folder, role)
        assert "\n" not in str(caught.value)
        return str(caught.value)

    for name, wrong in (("ca.pem", "not a certificate"), (f"{role}.pem", "not a certificate and its key")):
        whole = (tmp_path / name).read_bytes()
        (tmp_path / name).unlink()
        assert complaint().startswith(f"{tmp_path / name}: cannot be read (No such file or directory)")
        (tmp_path / name).write_bytes(b"-----BEGIN GARBAGE-----")
        assert complaint().startswith(str(tmp_path / name)) and wrong in complaint()
        (tmp_path / name).write_bytes(whole)
    genpkey = [
        "openssl",
        "genpkey",
        "-algorithm",
        "EC",
        "-pkeyopt",
        "ec_paramgen_curve:P-256",
        "-out",
        tmp_path / f"{role}.key",
    ]
    subprocess.run(genpkey, check=True)
    assert "key values mismatch" in complaint(), "the key of another certificate"
    subprocess.run([*genpkey, "-aes256", "-pass", "pass:x"], check=True)
    assert f"{role}.key" in complaint(), "a key with a password is refused, and nobody is asked for it"


def test_the_folder_may_lie_elsewhere_on_this_machine(made, tmp_path, monkeypatch):
    with pytest.raises(LinkError, match=f"{tmp_path}/ca.pem"):
        security.client(str(tmp_path), "worker")
    monkeypatch.setenv("ICRL_CERTIFICATES", made)
    assert security.client(str(tmp_path), "worker")["transport/link/tls/connect_certificate"] == f"{made}/worker.pem"
    assert security.client("", "worker") == {}, "it says where they lie, not that there are some"


class Captured(Exception):  # noqa: N818
    """Raised in place of a session: the configuration that one would have been opened with."""


@pytest.fixture
def configured(made, monkeypatch):
    """What the system opens a session with, by role."""

    def open_nothing(config):
        raise Captured(config)

    def configuration(role):
        with pytest.raises(Captured) as caught:
            if role == "learner":
                ZenohLink.listen("tls/HOST:7447", security.learner(made, "RUN"))
            else:
                ZenohLink.connect("tls/HOST:7447", 1.0, security.client(made, role))
        return caught.value.args[0]

    monkeypatch.setattr(zenoh_link.zenoh, "open", open_nothing)
    return configuration


def flat(value, prefix=""):
    if not isinstance(value, dict):
        return {prefix: value}
    return {key: v for name, inner in value.items() for key, v in flat(inner, f"{prefix}/{name}" if prefix else name).items()}


# How long to try and how large a buffer: of this system's link, and nobody's safety.
TUNING = ("connect/timeout_ms", "connect/exit_on_failure", "connect/retry", "transport/link/tx/", "transport/link/rx/")


def differences(template, system):
    here, there = flat(json.loads(str(template))), flat(json.loads(str(system)))
    return {k for k in here | there if here.get(k) != there.get(k) and not k.startswith(TUNING)}


@pytest.mark.parametrize("role", ROLES)
def test_a_template_is_what_the_system_sets(configured, made, tmp_path, role):
    text = (certificates.ZENOH / f"{role}.json5").read_text().replace("FOLDER", made)
    file = tmp_path / "template.json5"
    file.write_text(text)
    assert not differences(zenoh.Config.from_file(file), configured(role))
    drifts = [("enable_mtls: true", "enable_mtls: false"), ("/ca.pem", "/other.pem"), ("HOST:7447", "HOST:7448")]
    if role == "learner":
        drifts += [('["icrl/RUN/weights"]', '["**"]'), ('default_permission: "deny"', 'default_permission: "allow"')]
    for what, wrong in drifts:
        assert what in text
        file.write_text(text.replace(what, wrong))
        assert len(differences(zenoh.Config.from_file(file), configured(role))) == 1, "a template that drifts is noticed"


def off_host(**stream):
    return Run(stream=Run().stream.__class__(endpoint="tls/10.0.0.1:7447", **stream))


@pytest.mark.usefixtures("no_ray_token")
def test_a_cluster_off_this_machine_needs_rays_token(made, tmp_path, monkeypatch):
    run = off_host(certificates=made)
    remedy = r"--address head:6379: without a token.*ray get-auth-token --generate.*RAY_AUTH_MODE=token"
    with pytest.raises(ConfigError, match=remedy):
        check_security(run, "head:6379")
    (tmp_path / ".ray").mkdir()
    (tmp_path / ".ray" / "auth_token").write_text("a-token-of-this-test")
    with pytest.raises(ConfigError, match=remedy):
        check_security(run, "head:6379")  # Ray shows its token only when told to
    monkeypatch.setenv("RAY_AUTH_MODE", "token")
    check_security(run, "head:6379")
    (tmp_path / ".ray" / "auth_token").unlink()
    with pytest.raises(ConfigError, match=remedy) as caught:
        check_security(run, "head:6379")
    assert "a-token-of-this-test" not in str(caught.value)
    monkeypatch.delenv("RAY_AUTH_MODE")
    check_security(run, None)
    check_security(Run(), "127.0.0.1:6379")


@pytest.mark.usefixtures("no_ray_token")
def test_certificates_are_checked_before_anything_starts(made, tmp_path):
    (tmp_path / "half").mkdir()
    for name in ("ca.pem", "learner.pem", "learner.key"):
        (tmp_path / "half" / name).write_bytes((certificates.Path(made) / name).read_bytes())
    run = off_host(certificates=str(tmp_path / "half"))
    with pytest.raises(LinkError, match=r"half/worker\.pem: cannot be read"):
        check_security(run, None)
    with pytest.raises(ConfigError, match="--address"):
        check_security(run, "head:6379")  # the worker's lie on the workers' machines: only the token is missing
