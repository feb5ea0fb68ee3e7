"""What Ray reads and sets in this process: environment variables, the token, a running session."""

from __future__ import annotations

import contextlib
import os
import secrets
import sys
from collections.abc import Mapping

from icrl_dist.config.run import ConfigError
from icrl_dist.diagnostics.ray_token import token_file


def refuse_running_session() -> None:
    """Raises ConfigError if this process already uses Ray: a run would end that session, and all its work, with its own."""
    ray = sys.modules.get("ray")
    if ray is not None and ray.is_initialized():
        raise ConfigError(
            "engine 'ray': this process already uses Ray, and a run starts and ends a session of its own: call ray.shutdown() "
            "first, train in another process (`icrl-dist train`), or use engine='inline'"
        )


def variables() -> dict[str, str]:
    """The environment variables that Ray reads and sets."""
    return {name: value for name, value in os.environ.items() if name.startswith("RAY_") or name == "PYTHONBREAKPOINT"}


def restore_variables(former: Mapping[str, str]) -> None:
    """Set Ray's environment variables as ``variables`` returned them."""
    for name in variables():
        del os.environ[name]
    os.environ.update(former)


def forget_other_clusters() -> None:
    """Delete the variables that describe another Ray, such as RAY_ADDRESS, until ``restore_variables``.

    Kept are those of the token, RAY_TMPDIR, and Ray's settings, whose names are in small letters after ``RAY_``.
    """
    for name in variables():
        if name.isupper() and name != "RAY_TMPDIR" and not name.startswith("RAY_AUTH_"):
            os.environ.pop(name, None)


def protect_token() -> None:
    """Make sure that Ray's token exists and that only this user can read it: Ray itself makes it readable for all.

    Where it cannot be stored, it is in the environment until ``restore_variables``.
    """
    if os.environ.get("RAY_AUTH_MODE", "token") != "token" or os.environ.get("RAY_AUTH_TOKEN"):
        return
    token = secrets.token_hex(32)
    try:
        file = token_file()
        if file.is_file() and file.stat().st_size:
            with contextlib.suppress(OSError):  # another user's
                file.chmod(0o600)
            return
        file.parent.mkdir(parents=True, exist_ok=True)
        descriptor = os.open(file, os.O_WRONLY | os.O_CREAT | os.O_TRUNC, 0o600)
    except (OSError, RuntimeError):  # there is no home folder
        os.environ["RAY_AUTH_TOKEN"] = token
        return
    with os.fdopen(descriptor, "w") as opened:
        opened.write(token)
