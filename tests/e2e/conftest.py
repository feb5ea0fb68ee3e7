"""Runs that several tests compare with."""

import fcntl
import os
import shutil

import pytest

from tests.e2e.training import SMOKE, finish, result_of, start


@pytest.fixture(scope="session")
def reference(tmp_path_factory):
    """Smoke in one process: what every disturbed run must equal.  Made once for all processes of pytest-xdist."""
    base = tmp_path_factory.getbasetemp()
    folder = (base.parent if "PYTEST_XDIST_WORKER" in os.environ else base) / "inline"
    with folder.with_suffix(".lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        if not (folder / "result.json").exists():
            shutil.rmtree(folder, ignore_errors=True)  # of an attempt that failed
            process = start("train", *SMOKE, "--engine", "inline", "--out", folder)
            output = finish(process)
            assert process.returncode == 0, output
    return result_of(folder)
