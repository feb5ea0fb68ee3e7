"""Certificates and access rules: valid files are accepted, others named; templates equal the program's settings."""

import json
import os
import stat
import subprocess
from pathlib import Path

import pytest
import zenoh

from icrl_dist.config.run import ConfigError, Run
from icrl_dist.launch.train import check_security
from icrl_dist.stream import security
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


def test_the_script_makes_an_authority_and_a_certificate_for_each_role(tmp_path, made):
    names = sorted(f"{name}.{kind}" for name in ("ca", *ROLES) for kind in ("key", "pem"))
    assert sorted(os.listdir(made)) == names  # noqa: PTH208
    for name in names:
        assert stat.S_IMODE(os.stat(f"{made}/{name}").st_mode) == 0o600, "only the owner can read the keys"  # noqa: PTH116
    for role in ROLES:
        assert about(f"{made}/{role}.pem", "-subject").strip().endswith(f"CN = {role}")
        assert security.files(made, role) == tuple(f"{made}/{name}" for name in ("ca.pem", f"{role}.pem", f"{role}.key"))
        usage = about(f"{made}/{role}.pem", "-ext", "extendedKeyUsage")
        assert ("Server" in usage, "Client" in usage) == (role == "learner", role != "learner")
    names = about(f"{made}/learner.pem", "-ext", "subjectAltName")
    for name in ("DNS:localhost", "IP Address:127.0.0.1", "DNS:head.example", "IP Address:10.0.0.1", "IP Address:FD00:0:"):
        assert name in names


def test_a_second_run_of_the_script_keeps_the_authority(tmp_path):
    folder = certificates.make(tmp_path)
    before = {f.name: f.read_bytes() for f in tmp_path.iterdir()}
    certificates.make(tmp_path)
    after = {f.name: f.read_bytes() for f in tmp_path.iterdir()}
    assert {name for name in before if before[name] == after[name]} == {"ca.pem", "ca.key"}
    assert security.files(folder, "worker")


def test_without_certificates_there_are_no_settings():
    assert security.learner("", "run") == security.client("", "worker") == security.client("", "monitor") == {}


@pytest.mark.parametrize("role", ROLES)
def test_a_missing_or_invalid_file_is_named_with_the_remedy(tmp_path, role):
    folder = certificates.make(tmp_path)

    def error_text():
        with pytest.raises(LinkError, match=r"certificates\.sh.*docs/security\.md") as caught:
            security.files(folder, role)
        assert "\n" not in str(caught.value)
        return str(caught.value)

    for name, wrong in (("ca.pem", "not a certificate"), (f"{role}.pem", "not a certificate and its key")):
        whole = (tmp_path / name).read_bytes()
        (tmp_path / name).unlink()
        assert error_text().startswith(f"{tmp_path / name}: cannot be read (No such file or directory)")
        (tmp_path / name).write_bytes(b"-----BEGIN GARBAGE-----")
        assert error_text().startswith(str(tmp_path / name)) and wrong in error_text()
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
    assert "key values mismatch" in error_text(), "the key of another certificate"
    subprocess.run([*genpkey, "-aes256", "-pass", "pass:x"], check=True)
    assert f"{role}.key" in error_text(), "a key with a password is refused without a prompt"


def test_an_environment_variable_overrides_the_folder(made, tmp_path, monkeypatch):
    with pytest.raises(LinkError, match=f"{tmp_path}/ca.pem"):
        security.client(str(tmp_path), "worker")
    monkeypatch.setenv("ICRL_CERTIFICATES", made)
    assert security.client(str(tmp_path), "worker")["transport/link/tls/connect_certificate"] == f"{made}/worker.pem"
    assert security.client("", "worker") == {}, "the variable names the folder; it does not turn TLS on"


class OpenedWith(Exception):  # noqa: N818
    """Raised instead of opening a session; holds the session's configuration."""


@pytest.fixture
def configured(made, monkeypatch):
    """The configuration with which the program opens a session, by role."""

    def capture(config):
        raise OpenedWith(config)

    def configuration(role):
        with pytest.raises(OpenedWith) as caught:
            if role == "learner":
                ZenohLink.listen("tls/HOST:7447", security.learner(made, "RUN"))
            else:
                ZenohLink.connect("tls/HOST:7447", 1.0, security.client(made, role))
        return caught.value.args[0]

    monkeypatch.setattr(zenoh, "open", capture)
    return configuration


def flat(value, prefix=""):
    if not isinstance(value, dict):
        return {prefix: value}
    return {key: v for name, inner in value.items() for key, v in flat(inner, f"{prefix}/{name}" if prefix else name).items()}


# Timeouts and buffer sizes of our link, which do not concern security, and what depends on this machine.
TUNING = ("connect/timeout_ms", "connect/exit_on_failure", "connect/retry", "transport/link/tx/", "transport/link/rx/buffer")
MACHINE = ("transport/unicast/max_sessions",)


def differences(template, system):
    here, there = flat(json.loads(str(template))), flat(json.loads(str(system)))
    return {k for k in here | there if here.get(k) != there.get(k) and not k.startswith((*TUNING, *MACHINE))}


@pytest.mark.parametrize("role", ROLES)
def test_a_template_equals_the_settings_of_the_program(configured, made, tmp_path, role):
    text = (certificates.ZENOH / f"{role}.json5").read_text().replace("FOLDER", made)
    file = tmp_path / "template.json5"
    file.write_text(text)
    assert not differences(zenoh.Config.from_file(file), configured(role))
    changes = [("enable_mtls: true", "enable_mtls: false"), ("/ca.pem", "/other.pem"), ("HOST:7447", "HOST:7448")]
    if role == "learner":
        changes += [('["icrl/RUN/weights"]', '["**"]'), ('default_permission: "deny"', 'default_permission: "allow"')]
    for what, wrong in changes:
        assert what in text
        file.write_text(text.replace(what, wrong))
        assert len(differences(zenoh.Config.from_file(file), configured(role))) == 1, "a changed template fails"


def on_another_node(**stream):
    return Run(stream=Run().stream.__class__(endpoint="tls/10.0.0.1:7447", **stream))


@pytest.mark.usefixtures("no_ray_token")
def test_a_cluster_of_several_nodes_needs_rays_token(made, tmp_path, monkeypatch):
    run = on_another_node(certificates=made)
    remedy = r"--address head:6379: without a token.*ray get-auth-token --generate.*RAY_AUTH_MODE=token"
    with pytest.raises(ConfigError, match=remedy):
        check_security(run, "head:6379")
    (tmp_path / ".ray").mkdir()
    (tmp_path / ".ray" / "auth_token").write_text("a-token-of-this-test")
    with pytest.raises(ConfigError, match=remedy):
        check_security(run, "head:6379")  # Ray sends its token only with RAY_AUTH_MODE=token
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
        (tmp_path / "half" / name).write_bytes((Path(made) / name).read_bytes())
    run = on_another_node(certificates=str(tmp_path / "half"))
    with pytest.raises(LinkError, match=r"half/worker\.pem: cannot be read"):
        check_security(run, None)
    with pytest.raises(ConfigError, match="--address"):
        check_security(run, "head:6379")  # the workers' certificates are on their nodes, so only the token is missing
