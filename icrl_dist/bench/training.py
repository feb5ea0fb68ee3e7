"""A real training in a child process, for benchmarks that observe it from outside."""

from __future__ import annotations

import contextlib
import os
import signal
import subprocess
from collections.abc import Iterator
from pathlib import Path

from icrl_dist.telemetry import processes


@contextlib.contextmanager
def training(run: str, out: Path, *settings: str) -> Iterator[subprocess.Popen[str]]:
    """Run ``icrl-dist train RUN --out OUT`` and interrupt it at the end.

    The caller must read its standard output; its standard error goes to the terminal.
    """
    command = processes.python("-u", "-m", "icrl_dist.cli", "train", run, "--out", str(out), *settings)
    process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True, start_new_session=True, env=processes.environment())
    try:
        yield process
    finally:
        process.send_signal(signal.SIGINT)
        try:
            process.wait(60)
        except subprocess.TimeoutExpired:
            os.killpg(process.pid, signal.SIGKILL)
            process.wait()


def need_alive(process: subprocess.Popen[str]) -> None:
    """Raises RuntimeError if the training has ended."""
    if process.poll() is not None:
        raise RuntimeError(f"the run ended, exit code {process.returncode}; check the machine with `icrl-dist doctor`")
