"""Wrong uses of what is public are refused in one line with the argument; clear ones are accepted, whatever their type."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from icrl_dist import load_agent
from icrl_dist.agent.loading import shipped
from icrl_dist.cli import main
from icrl_dist.storage.checkpoint import Checkpoint, load_checkpoint, save_checkpoint
from icrl_dist.storage.files import StoreError


@pytest.mark.integration
def test_wrong_uses_are_refused_with_the_argument_and_clear_ones_are_accepted(tmp_path: Path) -> None:
    words = [sys.executable, "-m", "tests.hands.refusals", str(tmp_path)]
    ran = subprocess.run(words, capture_output=True, text=True, check=False)
    assert (ran.stdout, ran.returncode) == ("", 0), ran.stderr


@pytest.mark.parametrize("command", [["evaluate"], ["export"], ["play", "--web", "0"]], ids=lambda command: command[0])
def test_a_command_refuses_a_file_that_is_no_checkpoint_without_numpys_advice(
    command: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "notes.npz"
    path.write_text("no checkpoint")
    assert main.main([command[0], str(path), *command[1:]]) != 0
    (line,) = capsys.readouterr().err.strip().splitlines()
    assert f"{path}: not a checkpoint of this system" in line and "pickle" not in line


def test_an_observation_that_is_no_number_changes_nothing() -> None:
    """Before, one nan made the agent choose action 0 for ever, and ``surprise`` nan."""
    agent, other = load_agent("darkroom", seed=0), load_agent("darkroom", seed=0)
    for turn in range(8):
        obs, reward = np.array([[turn % 3, 1.0]]), np.array([0.0])
        with pytest.raises(ValueError, match="obs has the value nan"):
            agent.act(obs * np.nan)
        actions = [one.act(obs) for one in (agent, other)]
        assert actions[0] == actions[1]
        with pytest.raises(ValueError, match="reward has the value nan"):
            agent.observe(obs, actions[0], reward * np.nan, obs, [turn == 4])
        for one in (agent, other):
            one.observe(obs, actions[0], reward, obs, [turn == 4])
    assert agent.surprise == other.surprise and np.isfinite(agent.surprise).all()


def test_weights_that_are_no_numbers_are_not_loaded(tmp_path: Path) -> None:
    found = load_checkpoint(shipped("darkroom"))
    arrays = {name: array * np.nan if name.endswith("head.bias") else array for name, array in found.arrays.items()}
    save_checkpoint(tmp_path / "agent.npz", Checkpoint(arrays, found.manifest))
    with pytest.raises(StoreError, match=r"head\.bias are no finite numbers.*diverged"):
        load_agent(tmp_path / "agent.npz")
