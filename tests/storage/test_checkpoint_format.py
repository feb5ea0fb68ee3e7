"""A checkpoint or agent of another file format is refused in one line that says what to do."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from icrl_dist import load_agent
from icrl_dist.cli import main
from icrl_dist.storage.checkpoint import FORMAT, Checkpoint, load_checkpoint, save_checkpoint
from icrl_dist.storage.files import StoreError

STORED = Checkpoint({"model/x": np.arange(3.0)}, {"version": 0, "format": 2})


def renumbered(path: Path, number: object) -> None:
    """Write the file again with another format number; None: without, as 0.1.0 did."""
    with np.load(path) as file:
        parts = dict(file)
    del parts["file_format"]
    if number is not None:
        parts["file_format"] = np.array(number)
    np.savez(path, **parts)


@pytest.mark.parametrize("number", [FORMAT + 1, 0, "two"])
def test_a_file_of_another_format_is_refused(tmp_path: Path, number: object, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "agent.npz"
    save_checkpoint(path, STORED)
    renumbered(path, number)
    expected = (
        f"{path}: checkpoint of file format {number}, this version of icrl-dist reads format {FORMAT}: "
        "use the version that wrote it, or train again with this one"
    )
    for read in (load_checkpoint, load_agent):
        with pytest.raises(StoreError) as refused:
            read(path)
        assert str(refused.value) == expected
    assert main.main(["evaluate", str(path)]) != 0
    assert capsys.readouterr().err == f"icrl-dist: {expected}\n"


@pytest.mark.parametrize("number", [FORMAT, None])
def test_a_file_of_this_format_or_of_0_1_0_is_read_without_the_number(tmp_path: Path, number: object) -> None:
    path = tmp_path / "agent.npz"
    save_checkpoint(path, STORED)
    renumbered(path, number)
    found = load_checkpoint(path)
    assert found.manifest == STORED.manifest and found.arrays.keys() == STORED.arrays.keys()
