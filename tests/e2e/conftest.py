"""A run with which several tests compare their results."""

import fcntl
import os
import shutil

import pytest

from tests.e2e.training import SMOKE, finish, result_of, start


@pytest.fixture(scope="session")
def reference(tmp_path_factory):
    """The result of ``smoke`` in one process, which every disturbed run must equal; one run for all pytest-xdist processes."""
    base = tmp_path_factory.getbasetemp()
    folder = (base.parent if "PYTEST_XDIST_WORKER" in os.environ else base) / "inline"
    with folder.with_suffix(".lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        if not (folder / "result.json").exists():
            shutil.rmtree(folder, ignore_errors=True)  # left by a failed attempt
            process = start("train", *SMOKE, "--engine", "inline", "--out", folder)
            output = finish(process)
            assert process.returncode == 0, output
    return result_of(folder)
