"""Runs that several tests compare with."""

import pytest

from tests.e2e.training import LONGER, finish, result_of, start


@pytest.fixture(scope="session")
def longer(tmp_path_factory):
    """The longer run in one process: what every disturbed one must equal."""
    folder = tmp_path_factory.mktemp("runs") / "inline"
    process = start("train", "smoke", *LONGER, "--engine", "inline", "--out", folder)
    output = finish(process)
    assert process.returncode == 0, output
    return result_of(folder)
