"""Packages with problems or methods that cannot be imported."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest

from icrl_dist.config import plugins, run
from icrl_dist.config.run import ConfigError, load, override


@pytest.fixture(params=["raise ImportError('no simulator')", "1 / 0"])
def broken(
    request: pytest.FixtureRequest, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, install: Callable[..., None]
) -> None:
    (tmp_path / "broken_plugin.py").write_text(request.param)
    monkeypatch.syspath_prepend(tmp_path)
    install(problems={"broken": "broken_plugin:It"}, methods={"broken": "broken_plugin:It"})


def test_a_broken_package_is_an_error_only_for_a_run_that_uses_it(broken: None) -> None:
    assert load("smoke").problem == "darkroom" and "smoke" in run.packaged_runs()
    assert "broken" in plugins.names("problems") and "broken" not in plugins.importable("problems")
    for group in ("problem", "method"):
        with pytest.raises(ConfigError, match=f"{group} = 'broken': its package cannot be imported"):
            override(load("smoke"), [f"{group}=broken"], "--set")


def test_another_problem_replaces_the_section_of_the_former_one() -> None:
    changed = override(load("smoke"), ["problem=dmc-cartpole-balance", "control.horizon=400"], "--set")
    assert changed.problem == "dmc-cartpole-balance" and changed.section("control").horizon == 400
    with pytest.raises(ConfigError, match=r"section \[darkroom\]: problem = 'dmc-cartpole-balance' has no such section"):
        override(load("smoke"), ["problem=dmc-cartpole-balance", "darkroom.size=5"], "--set")
