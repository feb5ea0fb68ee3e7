"""A real training beside a benchmark: started, looked at from outside, and ended."""

from __future__ import annotations

import contextlib
import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path


@contextlib.contextmanager
def training(run: str, out: Path, *settings: str) -> Iterator[subprocess.Popen[str]]:
    """``icrl-dist train RUN --out OUT``, which is interrupted at the end; its standard output is to be read, and what
    it has to complain of is seen."""
    command = [sys.executable, "-u", "-m", "icrl_dist.cli", "train", run, "--out", str(out), *settings]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True, start_new_session=True)
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
    """Raises RuntimeError if the training is over."""
    if process.poll() is not None:
        raise RuntimeError(f"the run ended, exit code {process.returncode}; `icrl-dist doctor` may say why")
