"""Runs that several tests compare with."""

import pytest

from tests.e2e.training import SMOKE, finish, result_of, start


@pytest.fixture(scope="session")
def reference(tmp_path_factory):
    """Smoke in one process: what every disturbed run must equal."""
    folder = tmp_path_factory.mktemp("runs") / "inline"
    process = start("train", *SMOKE, "--engine", "inline", "--out", folder)
    output = finish(process)
    assert process.returncode == 0, output
    return result_of(folder)
