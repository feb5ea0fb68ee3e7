"""The doctor's checks of what a process is given: environment variables, home, caches, temporary folder, locks, clock."""

from __future__ import annotations

import contextlib
import datetime
import fcntl
import os
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

from icrl_dist import version
from icrl_dist.config.sac import SACConfig
from icrl_dist.diagnostics.checks import Check

SOCKETS_BYTES = 40
"""Longest path of a temporary folder in which Ray's sockets fit: the path of a Unix socket has at most 107 bytes."""
_CACHES = ("XDG_CACHE_HOME", "XDG_CONFIG_HOME", "MPLCONFIGDIR", "TORCH_HOME")
"""Variables that name folders in which libraries keep files."""


def checks() -> Iterator[Check]:
    """The checks of this process's user and environment; nothing is left on disk."""
    yield check_home()
    yield _expert_cache()
    yield from _cache_variables()
    yield check_temporary()
    yield check_ray_address()
    yield check_clock()
    yield from check_renderer()


def existing(folder: Path) -> Path:
    """The folder, or its nearest parent that exists."""
    folder = folder.absolute()
    while not folder.exists() and folder != folder.parent:
        folder = folder.parent
    return folder


def writable(name: str, folder: Path, remedy: str, otherwise: bool | None = False) -> Check:
    """Whether the folder, or its nearest parent that exists, can be written; ``otherwise``: the result if it cannot."""
    try:
        # A trial write, because permission bits are not enough (root, read-only mounts).
        with tempfile.TemporaryFile(dir=existing(folder)):
            pass
    except OSError as error:
        return Check(name, otherwise, f"{folder}: {error.strerror or error}", remedy)
    return Check(name, True, f"{folder} is writable")


def check_home() -> Check:
    """Whether this user has a home folder to write to.  A run does without one."""
    remedy = "set HOME to a folder you may write to: Ray and other libraries keep files there"
    try:
        return writable("home", Path.home(), remedy, None)
    except RuntimeError:
        return Check("home", None, "this user has none: HOME is not set, and there is no passwd entry", remedy)


def _expert_cache() -> Check:
    remedy = "set sac.cache to a folder you may write to, or each run trains its SAC experts again"
    try:
        return writable("expert cache", Path(SACConfig().cache).expanduser(), remedy, None)
    except RuntimeError:
        return Check("expert cache", None, f"{SACConfig().cache}: this user has no home folder", remedy)


def _cache_variables() -> Iterator[Check]:
    """Only variables with a wrong value: libraries ignore them or write elsewhere."""
    for name in _CACHES:
        value = os.environ.get(name)
        if value and not Path(value).is_absolute():
            yield Check(name, None, f"{value} is a relative path", f"unset {name}, or name a whole path")
        elif value and (check := writable(name, Path(value), f"unset {name}, or name a folder you may write to", None)).remedy:
            yield check


def check_temporary() -> Check:
    """Whether TMPDIR is a folder that can be written, and short enough for Ray's sockets; or /tmp in its place."""
    name, given = "temporary folder", os.environ.get("RAY_TMPDIR") or os.environ.get("TMPDIR")
    wrong = _unfit(given) if given else ""
    if given and not wrong:
        return Check(name, True, given)
    if reason := _unfit("/tmp"):
        return Check(name, False, f"{wrong or reason}; {reason}", "set RAY_TMPDIR to a short path of a folder you may write to")
    if wrong:
        return Check(name, None, wrong, "name a folder with a short path in TMPDIR, or unset it: /tmp is used")
    return Check(name, True, "/tmp")


def _unfit(folder: str) -> str:
    """Why Ray cannot put its sockets into a folder; empty if it can."""
    if len(os.fsencode(folder)) > SOCKETS_BYTES:
        return f"{folder} has more than {SOCKETS_BYTES} bytes, too many for the paths of Ray's sockets"
    if not Path(folder).is_dir():
        return f"{folder} is no folder"
    check = writable("", Path(folder), "no")
    return "" if check.ok else check.value


def check_ray_address() -> Check:
    """Whether RAY_ADDRESS names a cluster, which a run without --address does not use."""
    value = os.environ.get("RAY_ADDRESS")
    if not value:
        return Check("RAY_ADDRESS", True, "not set")
    remedy = "unset RAY_ADDRESS to run here; --address auto runs the workers on that cluster"
    return Check("RAY_ADDRESS", None, f"{value} names a Ray cluster", remedy)


def check_locks(folder: Path) -> Check:
    """Whether the file system of the run folders has locks, which keep two runs from using one folder."""
    remedy = "never start two runs in one folder, or choose another file system with --out"
    with contextlib.suppress(OSError), tempfile.TemporaryFile(dir=existing(folder)) as file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            return Check("locks", None, f"{folder}: the file system has none ({error.strerror})", remedy)
        return Check("locks", True, f"{folder} has file locks")
    return Check("locks", None, f"{folder}: not tested, because it cannot be written", remedy)


def check_clock() -> Check:
    """Whether the clock is later than this code: certificates are not valid before their time."""
    now, written = time.time(), Path(version.__file__).stat().st_mtime
    text = datetime.datetime.fromtimestamp(now, datetime.UTC).strftime("%Y-%m-%d %H:%M UTC")
    if now < written - 86400:
        value = f"{text}, earlier than this package was installed"
        return Check("clock", None, value, "set it, as in timedatectl set-ntp true: certificates would not be valid yet")
    return Check("clock", True, text)


def check_renderer() -> Iterator[Check]:
    """Whether MuJoCo can load the renderer that MUJOCO_GL names, if it names one; only drawing needs it."""
    from icrl_dist.problems.continuous import renderer

    value = os.environ.get("MUJOCO_GL", "")
    if renderer.missing or value not in renderer.OFF:
        ok = not renderer.missing
        remedy = "" if ok else "unset MUJOCO_GL, or install libegl1 or libosmesa6: only env.render() needs it"
        yield Check("MUJOCO_GL", ok or None, value if ok else renderer.missing[0], remedy)
