"""The processes of a sweep's runs on this machine."""

from __future__ import annotations

import contextlib
import signal
import subprocess
from pathlib import Path
from typing import Protocol

from icrl_dist.telemetry import processes

COMMAND = ("-m", "icrl_dist.sweeps.one")
"""The words of Python that do one run; the run comes on standard input, which stays open as long as the sweep runs."""
ENVIRONMENT = {"OMP_NUM_THREADS": "1", "MKL_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
"""One thread for each library, because the runs share the cores."""


class Process(Protocol):
    """A process that does one run."""

    error: str
    """Why it could not be started, in one line; empty if it could."""

    def poll(self) -> int | None:
        """Its exit code, that of a signal below 0; None while it runs."""
        ...

    def stop(self) -> None:
        """Let it end with a checkpoint."""
        ...

    def kill(self) -> None:
        """End it at once, and wait for its end."""
        ...


class Start(Protocol):
    """``start(message, log)``: start the process of a run; what it prints is appended to ``log``."""

    def __call__(self, message: bytes, log: Path) -> Process: ...


class Child:
    """A child process of this one.  It gets no Ctrl-C of the terminal: the sweep ends it."""

    error = ""

    def __init__(self, message: bytes, log: Path) -> None:
        with log.open("ab") as output:
            self._process = subprocess.Popen(
                processes.python(*COMMAND),
                stdin=subprocess.PIPE,
                stdout=output,
                stderr=output,
                start_new_session=True,
                env={**processes.environment(), **ENVIRONMENT},
            )
        assert self._process.stdin is not None
        try:
            self._process.stdin.write(message)
            self._process.stdin.flush()
        except BrokenPipeError:
            pass  # it has ended; ``poll`` says how
        except BaseException:
            self.kill()
            raise

    @property
    def pid(self) -> int:
        return self._process.pid

    def poll(self) -> int | None:
        code = self._process.poll()
        if code is not None:
            self._close()
        return code

    def stop(self) -> None:
        self._process.send_signal(signal.SIGTERM)

    def kill(self) -> None:
        self._process.kill()
        self._process.wait()
        self._close()

    def _close(self) -> None:
        assert self._process.stdin is not None
        with contextlib.suppress(BrokenPipeError):
            self._process.stdin.close()
