"""Endpoints that a learner may use: other nodes only with certificates, and errors with the remedy."""

import re

import pytest

from icrl_dist.config.run import ConfigError, parse
from icrl_dist.stream import endpoints

UNENCRYPTED = "unencrypted only on this node"


def stream(**values):
    return "[stream]\n" + "\n".join(f'{name} = "{value}"' for name, value in values.items())


@pytest.mark.parametrize("host", ["127.0.0.1", "127.8.9.10", "[::1]", "localhost"])
def test_loopback_needs_no_certificates(host):
    assert endpoints.parse(f"tcp/{host}:7447").loopback
    assert parse(stream(endpoint=f"tcp/{host}:7447"), "mine").stream.certificates == ""


@pytest.mark.parametrize("host", ["0.0.0.0", "[::]", "10.0.0.1", "head", "127.0.0.1.example.org", "[::ffff:10.0.0.1]", "127.1"])
def test_any_other_address_needs_tls_and_certificates(host):
    assert not endpoints.parse(f"tcp/{host}:7447").loopback
    with pytest.raises(ConfigError, match=rf"stream.endpoint = .*{UNENCRYPTED}.*stream.certificates.*docs/security.md"):
        parse(stream(endpoint=f"tcp/{host}:7447"), "mine")
    with pytest.raises(ConfigError, match=r"stream.endpoint = .*TLS needs stream.certificates"):
        parse(stream(endpoint=f"tls/{host}:7447"), "mine")
    with pytest.raises(ConfigError, match=r"stream.endpoint = .*write it as tls/HOST:PORT"):
        parse(stream(endpoint=f"tcp/{host}:7447", certificates="c"), "mine")
    run = parse(stream(endpoint=f"tls/{host}:7447", certificates="c", connect="tls/head.example:1"), "mine")
    assert run.stream.connect == "tls/head.example:1"


def test_certificates_are_used_on_loopback_too():
    with pytest.raises(ConfigError, match=r"stream.certificates is set"):
        parse(stream(certificates="c"), "mine")
    assert parse(stream(endpoint="tls/127.0.0.1:0", certificates="c"), "mine").stream.certificates == "c"


@pytest.mark.parametrize(
    "endpoint", ["", "tcp", "tcp/127.0.0.1", "127.0.0.1:7447", "tcp/127.0.0.1:70000", "tcp/::1:7447", "tcp/a b:1"]
)
def test_an_invalid_endpoint_is_refused_with_the_expected_form(endpoint):
    with pytest.raises(ConfigError, match=r"stream.endpoint = .*write it as tcp/127.0.0.1:PORT"):
        parse(stream(endpoint=endpoint), "mine")


@pytest.mark.parametrize("host", ["0.0.0.0", "[::]"])
def test_an_endpoint_on_all_addresses_needs_an_address_to_connect_to(host):
    everywhere = {"endpoint": f"tls/{host}:7447", "certificates": "c"}
    with pytest.raises(ConfigError, match=r"stream.connect = ''.*name one address"):
        parse(stream(**everywhere), "mine")
    for invalid in (f"tls/{host}:7447", "tls/head:0"):
        with pytest.raises(ConfigError, match=rf"stream.connect = '{re.escape(invalid)}'.*name one address"):
            parse(stream(**everywhere, connect=invalid), "mine")


def test_an_unencrypted_connection_stays_on_this_node():
    assert parse(stream(connect="tcp/127.0.0.1:9000"), "mine").stream.connect == "tcp/127.0.0.1:9000"
    with pytest.raises(ConfigError, match=rf"stream.connect = 'tcp/head:9000'.*{UNENCRYPTED}"):
        parse(stream(connect="tcp/head:9000"), "mine")
