"""Ray's authentication token: whether this process has one."""

from __future__ import annotations

import os
from pathlib import Path

from icrl_dist.config.run import ConfigError
from icrl_dist.diagnostics.checks import Check


def token_file() -> Path:
    """The file in which Ray stores its token."""
    return Path(os.environ.get("RAY_AUTH_TOKEN_PATH") or Path.home() / ".ray" / "auth_token")


def check_ray_token() -> Check:
    """Whether a token is present, if RAY_AUTH_MODE requires one.

    With authentication on, Ray 2.60 refuses every connection without a token.
    """
    mode = os.environ.get("RAY_AUTH_MODE", "disabled")
    if mode != "token":
        return Check("Ray token", True, f"not needed (RAY_AUTH_MODE is {mode})")
    if os.environ.get("RAY_AUTH_TOKEN"):
        return Check("Ray token", True, "in RAY_AUTH_TOKEN")
    file = token_file()
    try:
        ok = bool(file.read_text().strip())
        readable = file.stat().st_mode & 0o077
    except OSError:
        ok = readable = False
    if ok and readable:
        return Check("Ray token", None, f"in {file}, which other users can read", f"chmod 600 {file}")
    return Check("Ray token", ok, f"in {file}" if ok else f"none in {file}", "" if ok else "ray get-auth-token --generate")


def require_ray_token(address: str) -> None:
    """Raise ConfigError unless this process has a token for the Ray cluster at ``address``.

    Ray turns authentication on by itself only for clusters that it starts, never for a given address.
    """
    check = check_ray_token()
    if os.environ.get("RAY_AUTH_MODE") != "token" or check.ok is False:
        raise ConfigError(
            f"--address {address}: without a token anyone who reaches Ray's ports can run code there "
            f"(Ray token: {check.value}); make one with `ray get-auth-token --generate`, copy it to every node "
            "with mode 600, and set RAY_AUTH_MODE=token there and here"
        )
