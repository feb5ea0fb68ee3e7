"""A session of Ray on this machine: its folder, its start, the death of its processes, and its end.

Ray is an argument: only ``fleet`` imports it.  A session is ours alone: it listens on 127.0.0.1 only, whatever
other Ray this machine or its environment variables name, and nothing of it is left after ``close``.
"""

from __future__ import annotations

import contextlib
import logging
import os
import shutil
import tempfile
import threading
import time
from collections.abc import Callable, Collection, Iterator
from pathlib import Path
from typing import IO, Any

import psutil

from actors.running_time import RunningTime
from icrl_dist.diagnostics import ray_job
from icrl_dist.storage.files import held, hold

TRIES = 3
"""Attempts to start Ray before a run fails."""
STOPPED_S = 30.0
"""Seconds after which a process of Ray that is stopped (SIGSTOP) counts as dead."""
SHUTDOWN_S = 15.0
"""Seconds that Ray has to end its processes; those that are left are killed."""
_LIST_S = 2.0
"""Seconds between two looks at the processes that Ray's processes started."""
_VITAL = ("gcs_server", "raylet")
"""Names of the processes without which no worker can be started."""
_PREFIX, _LOGS = "icrl-ray-", "icrl-ray-logs-"
_BASE_BYTES = 107 - len(f"/{_PREFIX}12345678/session_2026-01-01_00-00-00_000000_1234567/sockets/plasma_store")
"""Longest path of a folder for sessions: the path of a Unix socket has at most 107 bytes (103 on macOS)."""
_YOUNG_S, _OLD_S = 60.0, 7 * 86400.0

_log = logging.getLogger(__name__)


class SessionFailed(RuntimeError):  # noqa: N818
    """Ray does not start on this machine; the message is one line with the cause and the remedy."""


class Session:
    """Ray's processes on this machine, started by the constructor; ``restart`` replaces all of them."""

    def __init__(
        self, ray: Any, note: Callable[[str], None], stopped: Callable[[], bool] = lambda: False, **options: Any
    ) -> None:
        """Start Ray with these options of ``ray.init``.

        An error that may pass, such as a time limit on a busy machine, is followed by another attempt, of which ``note``
        gets a line; other errors are final.  Raises SessionFailed, at the latest after ``TRIES`` attempts, or after a
        failed one if ``stopped()`` is true.
        """
        self._ray, self._note, self._stopped, self._options = ray, note, stopped, options
        self._folder: Path | None = None
        self._lock: IO[bytes] | None = None
        self._vital: dict[psutil.Process, str] = {}
        """The processes without which no worker can be started, with their names."""
        self._family: set[psutil.Process] = set()
        """All processes of the session that were seen."""
        self._listed = 0.0
        self._clock = RunningTime()
        self._stopped_since: dict[psutil.Process, float] = {}
        self._silence = contextlib.ExitStack()
        self._silence.enter_context(_silent(ray))
        try:
            self._start()
        except BaseException:
            self._silence.close()
            raise

    def _start(self) -> None:
        for number in range(1, TRIES + 1):
            try:
                self._folder, self._lock = _new_folder()
                with _on_loopback(self._ray), sigterm_unchanged(self._ray):
                    self._ray.init(
                        address="local",
                        job_config=ray_job.job_config(self._ray),
                        _node_ip_address="127.0.0.1",
                        _temp_dir=str(self._folder),
                        include_dashboard=False,
                        log_to_driver=False,
                        logging_level=logging.ERROR,
                        **self._options,
                    )
            except Exception as error:  # Ray raises no specific type
                last = _final(error) or number == TRIES
                logs = self._end(keep_logs=last and not self._stopped())
                cause = str(error).splitlines()[0] if str(error) else type(error).__name__
                text = f"Ray did not start on this machine ({cause})"
                if last or self._stopped():
                    where = f"its logs are in {logs}" if logs else "`icrl-dist doctor` checks this machine"
                    times = "once" if number == 1 else f"{number} times"
                    raise SessionFailed(f"{text}, tried {times}; {where}") from error
                self._note(f"{text}: starting it again, {number + 1} of {TRIES}")
            else:
                self._list()
                self._vital = {process: name for process in self._family if (name := _name(process)) in _VITAL}
                self._listed = 0.0
                return

    def failure(self) -> str:
        """What has happened to a process of Ray so that only ``restart`` helps; empty while all of them are running.

        To be called at least once a second.
        """
        now = self._clock()
        if now - self._listed >= _LIST_S or not self._listed:
            self._listed = now
            self._list()
        for process, name in self._vital.items():
            status = _status(process)
            if status in (psutil.STATUS_DEAD, psutil.STATUS_ZOMBIE):
                return f"Ray's process {name} ({process.pid}) has ended"
            since = self._stopped_since.setdefault(process, now)
            if status != psutil.STATUS_STOPPED:
                self._stopped_since[process] = now
            elif now - since >= STOPPED_S:
                return f"Ray's process {name} ({process.pid}) has been stopped for {STOPPED_S:.0f} s"
        return ""

    def _list(self) -> None:
        """Note the processes of the session: they cannot be found after the end of their parents."""
        if self._folder is None:  # the session has ended
            return
        self._family |= {process for process in psutil.Process().children() if str(self._folder) in _command_line(process)}
        for process in self._vital:
            with contextlib.suppress(psutil.NoSuchProcess):
                self._family |= set(process.children(recursive=True))

    def restart(self) -> None:
        """End all processes of the session and start a new one.

        Raises SessionFailed as the constructor, and if ``stopped()`` is true.
        """
        self._end()
        if self._stopped():
            raise SessionFailed("Ray is not started again, because the run was interrupted")
        self._start()

    def close(self) -> None:
        """End all processes of the session and remove its folder."""
        self._end()
        self._silence.close()

    def _end(self, keep_logs: bool = False) -> Path | None:
        """As ``close``; returns the folder of the logs if they are kept and there are any."""
        self._list()
        timer = threading.Timer(SHUTDOWN_S, _kill, [self._family])  # Ray's own shutdown waits for processes that are gone
        timer.start()
        try:
            self._ray.shutdown()
        finally:
            timer.cancel()
        _kill(self._family)
        self._family, self._vital, self._stopped_since = set(), {}, {}
        folder, self._folder = self._folder, None
        kept = _keep_logs(folder) if folder is not None and keep_logs else None
        if folder is not None:
            shutil.rmtree(folder, ignore_errors=True)
        if self._lock is not None:
            self._lock.close()
            self._lock = None
        return kept


def _name(process: psutil.Process) -> str:
    with contextlib.suppress(psutil.NoSuchProcess):
        return str(process.name())
    return ""


def _command_line(process: psutil.Process) -> str:
    with contextlib.suppress(psutil.Error):
        return " ".join(process.cmdline())
    return ""


def _status(process: psutil.Process) -> str:
    with contextlib.suppress(psutil.NoSuchProcess):
        if process.is_running():
            return str(process.status())
    return str(psutil.STATUS_DEAD)


def _kill(processes: Collection[psutil.Process]) -> None:
    """SIGKILL processes and all that they started, and wait for their end."""
    family = set(processes)
    for process in processes:
        with contextlib.suppress(psutil.NoSuchProcess):
            family |= set(process.children(recursive=True))
    for process in family:
        with contextlib.suppress(psutil.NoSuchProcess):
            process.kill()
    psutil.wait_procs(family, timeout=5.0)


def _final(error: BaseException) -> bool:
    """Whether another attempt to start Ray would fail alike: an impossible value, place or permission, not a time limit."""
    if isinstance(error, (ConnectionError, TimeoutError)):
        return False
    return isinstance(error, (OSError, ValueError, TypeError, ImportError, AttributeError))


@contextlib.contextmanager
def _replaced(module: Any, name: str, function: Callable[..., Any]) -> Iterator[None]:
    """Another function in a module of Ray."""
    before = getattr(module, name)
    setattr(module, name, function)
    try:
        yield
    finally:
        setattr(module, name, before)


def _on_loopback(ray: Any) -> contextlib.AbstractContextManager[None]:
    """Let Ray listen on 127.0.0.1: ``ray.init`` replaces that by an address of the network, and listens on every address."""
    return _replaced(ray._private.services, "resolve_ip_for_localhost", lambda host: host)


def _silent(ray: Any) -> contextlib.AbstractContextManager[None]:
    """Keep a thread of Ray from printing the log of a process that has ended."""
    return _replaced(ray._private.worker, "print_to_stdstream", lambda data, **_: _log.info("%s", data))


def sigterm_unchanged(ray: Any) -> contextlib.AbstractContextManager[None]:
    """Keep Ray from replacing the handler of SIGTERM: its own ends the process in the middle of native code, which aborts."""
    return _replaced(ray._private.utils, "set_sigterm_handler", lambda handler: None)


def _new_folder() -> tuple[Path, IO[bytes]]:
    """A new folder for a session, readable by this user only, and its lock; folders of killed runs are removed.

    Raises OSError if there is no writable folder with a short enough path.
    """
    named = [os.environ.get(name) for name in ("RAY_TMPDIR", "TMPDIR")]
    bases = dict.fromkeys(base for base in (*named, "/tmp", os.environ.get("XDG_RUNTIME_DIR"), "/dev/shm") if base)
    errors = list[str]()
    for base in bases:
        if len(os.fsencode(base)) > _BASE_BYTES:
            errors.append(f"{base}: longer than {_BASE_BYTES} bytes, too long for Unix sockets")
            continue
        try:
            folder = Path(tempfile.mkdtemp(prefix=_PREFIX, dir=Path(base).absolute()))
        except OSError as error:
            errors.append(f"{base}: {error.strerror}")
            continue
        lock = hold(folder)
        _sweep(folder.parent)
        return folder, lock
    raise OSError(f"no folder for its sockets; set RAY_TMPDIR to a short, writable one: {'; '.join(errors)}")


def _sweep(base: Path) -> None:
    """Remove the folders of sessions whose run was killed, and logs older than ``_OLD_S``, as far as they are ours."""
    for folder in base.glob(f"{_PREFIX}*"):
        with contextlib.suppress(OSError):
            status = folder.lstat()
            limit = _OLD_S if folder.name.startswith(_LOGS) else _YOUNG_S
            if status.st_uid == os.getuid() and time.time() - status.st_mtime > limit and not held(folder):
                shutil.rmtree(folder, ignore_errors=True)


def _keep_logs(folder: Path) -> Path | None:
    """Move the logs of a session out of its folder, if there are any; returns their new folder."""
    for logs in folder.glob("session_2*/logs"):
        if any(file.stat().st_size for file in logs.iterdir() if file.is_file()):
            kept = folder.with_name(folder.name.replace(_PREFIX, _LOGS))
            logs.rename(kept)
            return kept
    return None
