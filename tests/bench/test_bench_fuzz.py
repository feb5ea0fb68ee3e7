"""The fuzz benchmark: our readers pass, a defective reader is found, and its failing input is written."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from icrl_dist.bench import fuzz
from icrl_dist.bench.mutations import mutate
from icrl_dist.cli.main import main
from icrl_dist.config.run import ConfigError


def test_our_readers_accept_or_refuse_every_input(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(fuzz, "LIMIT_MS", float("inf"))  # the type checks of tests make the readers slow
    result = fuzz.run(inputs=160, folder=tmp_path / "failing")
    assert result["ok"] and result["crashes"] == 0 and result["kept"] == [] and not (tmp_path / "failing").exists()
    assert result["accepted"] + result["rejected"] == 160 and result["accepted"] > 0
    assert json.loads(json.dumps(result)) == result


def test_every_valid_input_is_accepted() -> None:
    for name, target in fuzz.targets().items():
        for data in target.valid:
            target.read(data)
            assert data, name


def allocate_64_mb(data: bytes) -> None:
    np.zeros(64 << 20, np.uint8)


@pytest.mark.parametrize(("read", "crashes"), [(lambda data: {}[data], 3), (allocate_64_mb, 0)])
def test_an_input_on_which_a_reader_fails_is_written(
    read: Callable[[bytes], object],
    crashes: int,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(fuzz, "targets", lambda: {"broken": fuzz.Target(read, ValueError, [b"valid"])})
    result = fuzz.run(inputs=3, seed=7, folder=tmp_path)
    assert not result["ok"] and result["crashes"] == crashes
    assert [Path(f).name for f in result["kept"]] == [f"fuzz-broken-7-{n}.bin" for n in range(3)]
    again = mutate(np.random.default_rng([7, 2]), [b"valid"])
    assert Path(result["kept"][2]).read_bytes() == again
    assert "failing input: " in fuzz.describe(result)


def test_a_failure_is_exit_code_1(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    real = fuzz.run
    monkeypatch.setattr(
        fuzz, "targets", lambda: {"broken": fuzz.Target(dict[bytes, bytes]().__getitem__, ValueError, [b"valid"])}
    )
    monkeypatch.setattr(fuzz, "run", lambda folder: real(inputs=2, folder=folder))
    assert main(["bench", "fuzz", "--folder", str(tmp_path)]) == 1
    assert main(["bench", "fuzz", "--seconds", "1"]) == 2


def test_zero_inputs_are_refused() -> None:
    with pytest.raises(ConfigError, match="inputs = 0"):
        fuzz.run(inputs=0)
