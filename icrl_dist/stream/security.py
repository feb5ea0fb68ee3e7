"""Who may talk to the learner, and about what: TLS both ways, and rules by role.

Without certificates a stream stays on its machine and all of this is empty.  With them the
learner takes only clients whose certificate the same authority signed, and lets each do what
its role does: the certificate's common name, ``worker`` or ``monitor``.  docs/security.md.

Settings are Zenoh's keys, for ``ZenohLink.listen`` and ``ZenohLink.connect``; the templates in
deploy/zenoh hold the same for other programs.
"""

from __future__ import annotations

import os
import ssl
from pathlib import Path
from typing import Literal

from icrl_dist.stream.link import LinkError, StreamKeys

FOLDER = "ICRL_CERTIFICATES"
"""Environment variable: the folder of certificates on a machine where they lie elsewhere."""

REMEDY = "deploy/zenoh/certificates.sh makes what is needed, docs/security.md says what goes where"

Settings = dict[str, object]


def learner(certificates: str, run_name: str) -> Settings:
    """What a learner that listens needs; nothing if ``certificates`` is empty.

    Raises LinkError naming the file if one is missing or is not what it should be.
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
    """What a client of a learner needs; nothing if ``certificates`` is empty.

    Raises LinkError naming the file if one is missing or is not what it should be.
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
    """The rules, as the learner's end of each connection sees them: what comes in, what goes out.

    What is not allowed is denied.  The answers to a client's own declarations (``declare_*``
    going out) are allowed too: a publisher or querier that hears of nobody sends nothing.
    """
    asked = [keys.data, keys.work, keys.weights_latest]
    watched = ["icrl/*/mon/**"]  # a tap listens to whichever run is here
    rules: dict[str, tuple[str, list[str], list[str]]] = {
        "worker asks": ("ingress", ["query"], asked),
        "worker is answered": ("egress", ["reply", "declare_queryable"], asked),
        "worker follows the weights": ("ingress", ["declare_subscriber"], [keys.weights]),
        "worker receives the weights": ("egress", ["put"], [keys.weights]),
        "worker tells monitors": ("ingress", ["put"], [keys.monitor_all]),
        "worker hears of monitors": ("egress", ["declare_subscriber"], watched),
        "worker is alive": ("ingress", ["liveliness_token"], [keys.alive_all]),
        "monitor watches": ("ingress", ["declare_subscriber"], watched),
        "monitor is told": ("egress", ["put"], watched),
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
    """The folder's whole path; empty if ``certificates`` is."""
    return str(Path(certificates).expanduser().absolute()) if certificates else ""


def files(certificates: str, role: str) -> tuple[str, str, str]:
    """The authority's certificate, the role's own and its key; empty if ``certificates`` is.

    Raises LinkError naming the file if one is missing or is not what it should be.
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
        context.load_cert_chain(certificate, key, password=lambda: "")  # a key with a password would be asked for
    except ssl.SSLError as error:
        raise LinkError(f"{certificate} and {key.name}: not a certificate and its key ({_reason(error)}); {REMEDY}") from None
    return str(authority), str(certificate), str(key)


def _reason(error: ssl.SSLError) -> str:
    return (error.reason or str(error)).lower().replace("_", " ")
