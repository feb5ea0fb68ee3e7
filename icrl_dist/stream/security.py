"""Access to the learner: mutual TLS, and access rules by role.

Without certificates a stream stays on its node, and all settings here are empty.  With
certificates the learner accepts only clients with a certificate of the same authority.  The
certificate's common name is the client's role, ``worker`` or ``monitor``, and decides what the
client may do (docs/security.md).

Settings are Zenoh's keys, for ``ZenohLink.listen`` and ``ZenohLink.connect``.  The templates in
deploy/zenoh hold the same settings for other programs.
"""

from __future__ import annotations

import os
import ssl
from pathlib import Path
from typing import Literal

from icrl_dist.stream.link import LinkError, StreamKeys

FOLDER = "ICRL_CERTIFICATES"
"""Environment variable: the folder of certificates, on a node where it differs from the run file's."""

REMEDY = "deploy/zenoh/certificates.sh makes the files, docs/security.md says which node needs which"

Settings = dict[str, object]


def learner(certificates: str, run_name: str) -> Settings:
    """The settings of a learner; empty if ``certificates`` is.

    Raises LinkError with the file's name if one is missing or invalid.
    """
    if not certificates:
        return {}
    authority, certificate, key = files(certificates, "learner")
    return {
        **_tls(authority),
        "transport/link/tls/listen_certificate": certificate,
        "transport/link/tls/listen_private_key": key,
        "access_control": _access(StreamKeys(run_name)),
    }


def client(certificates: str, role: Literal["worker", "monitor"]) -> Settings:
    """The settings of a client of a learner; empty if ``certificates`` is.

    Raises LinkError with the file's name if one is missing or invalid.
    """
    if not certificates:
        return {}
    authority, certificate, key = files(certificates, role)
    return {
        **_tls(authority),
        "transport/link/tls/connect_certificate": certificate,
        "transport/link/tls/connect_private_key": key,
        "transport/link/tls/verify_name_on_connect": True,
    }


def _tls(authority: str) -> Settings:
    return {
        "transport/link/tls/root_ca_certificate": authority,
        "transport/link/tls/enable_mtls": True,
        "transport/link/tls/close_link_on_expiration": True,
    }


def _access(keys: StreamKeys) -> dict[str, object]:
    """The access rules, applied at the learner's end of each connection to incoming and outgoing messages.

    Everything else is denied.  Outgoing ``declare_*`` messages are allowed, because a publisher
    or querier that receives no declaration sends nothing.
    """
    requested = [keys.data, keys.work, keys.weights_latest]
    monitored = ["icrl/*/mon/**"]  # a tap need not know the run's name
    rules: dict[str, tuple[str, list[str], list[str]]] = {
        "worker sends requests": ("ingress", ["query"], requested),
        "worker receives replies": ("egress", ["reply", "declare_queryable"], requested),
        "worker subscribes to weights": ("ingress", ["declare_subscriber"], [keys.weights]),
        "worker receives weights": ("egress", ["put"], [keys.weights]),
        "worker publishes to monitors": ("ingress", ["put"], list(keys.monitor_of_workers)),
        "worker learns of subscribers": ("egress", ["declare_subscriber"], monitored),
        "worker holds a liveliness token": ("ingress", ["liveliness_token"], [keys.alive_all]),
        "monitor subscribes": ("ingress", ["declare_subscriber"], monitored),
        "monitor receives messages": ("egress", ["put"], monitored),
        "monitor asks for the past": ("ingress", ["query"], ["icrl/*/mon/past"]),
        "monitor receives the past": ("egress", ["reply", "declare_queryable"], ["icrl/*/mon/past"]),
    }
    roles = ("worker", "monitor")
    return {
        "enabled": True,
        "default_permission": "deny",
        "rules": [
            {"id": name, "permission": "allow", "flows": [flow], "messages": messages, "key_exprs": key_exprs}
            for name, (flow, messages, key_exprs) in rules.items()
        ],
        "subjects": [{"id": role, "cert_common_names": [role], "link_protocols": ["tls"]} for role in roles],
        "policies": [{"subjects": [role], "rules": [name for name in rules if name.startswith(role)]} for role in roles],
    }


def folder(certificates: str) -> str:
    """The folder's absolute path; empty if ``certificates`` is.  Raises LinkError for ``~`` if this user has no home."""
    try:
        return str(Path(certificates).expanduser().absolute()) if certificates else ""
    except RuntimeError:
        raise LinkError(f"{certificates}: this user has no home folder: set HOME, or write the whole path") from None


def files(certificates: str, role: str) -> tuple[str, str, str]:
    """The paths of the authority's certificate, the role's certificate and its key; empty if ``certificates`` is.

    Raises LinkError with the file's name if one is missing or invalid.
    """
    if not certificates:
        return "", "", ""
    place = Path(folder(os.environ.get(FOLDER) or certificates))
    authority, certificate, key = place / "ca.pem", place / f"{role}.pem", place / f"{role}.key"
    for file in (authority, certificate, key):
        try:
            file.read_bytes()
        except OSError as error:
            raise LinkError(f"{file}: cannot be read ({error.strerror}); {REMEDY}") from None
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    try:
        context.load_verify_locations(authority)
    except ssl.SSLError as error:
        raise LinkError(f"{authority}: not a certificate ({_reason(error)}); {REMEDY}") from None
    try:
        context.load_cert_chain(certificate, key, password=lambda: "")  # so that OpenSSL does not prompt for one
    except ssl.SSLError as error:
        raise LinkError(f"{certificate} and {key.name}: not a certificate and its key ({_reason(error)}); {REMEDY}") from None
    return str(authority), str(certificate), str(key)


def _reason(error: ssl.SSLError) -> str:
    return (error.reason or str(error)).lower().replace("_", " ")
