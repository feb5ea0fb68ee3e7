"""Packages with problems or methods that cannot be imported."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest

from icrl_dist.config import plugins, run
from icrl_dist.config.run import ConfigError, load, override
from tests.toys.site import CORRIDOR, SLIPPERY, installed


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


def source(site: Path, files: dict[str, str], module: str = "toy_problem", number: str = "1.0") -> plugins.Source:
    with installed(site, files, module, number):
        found = plugins.sources()
        assert list(found) == ["problems/toy"], "problems and methods of this package are left out"
        return found["problems/toy"]


def test_the_source_of_a_loose_module_is_its_file(tmp_path: Path) -> None:
    one = source(tmp_path / "a", {"toy_problem.py": CORRIDOR, "other.py": "x = 1"})
    assert (one.distribution, one.version, len(one.code)) == ("toys", "1.0", 64)
    assert source(tmp_path / "b", {"toy_problem.py": CORRIDOR, "other.py": "x = 2"}) == one
    changed = source(tmp_path / "c", {"toy_problem.py": SLIPPERY})
    assert changed.code != one.code and changed[:2] == one[:2]
    assert source(tmp_path / "d", {"toy_problem.py": CORRIDOR}, number="1.1") == one._replace(version="1.1")


@pytest.mark.parametrize("above", ["", "company/"])
def test_the_source_of_a_package_is_all_its_files_also_within_a_namespace(tmp_path: Path, above: str) -> None:
    module = f"{above}toy_package.sub.problem".replace("/", ".")
    files = {
        f"{above}toy_package/__init__.py": "1 / 0  # nothing is imported",
        f"{above}toy_package/sub/__init__.py": "",
        f"{above}toy_package/sub/problem.py": CORRIDOR,
        f"{above}toy_package/numbers.toml": "a = 1",
        "company/other.py": "x = 1",
    }
    one = source(tmp_path / "a", files, module)
    assert len(one.code) == 64
    assert source(tmp_path / "b", {**files, "company/other.py": "x = 2"}, module) == one
    for name in list(files)[:4]:
        changed = source(tmp_path / "c" / name, {**files, name: f"{files[name]}\n"}, module)
        assert changed.code != one.code, name


def test_a_package_whose_module_is_missing_has_no_code(tmp_path: Path) -> None:
    for module in ("toy_problem", "missing.toy_problem"):
        assert source(tmp_path / module, {}, module).code == ""


def test_the_problems_of_the_tests_have_a_source(tmp_path: Path) -> None:
    assert len(source(tmp_path, {}, "tests.toys.corridor").code) == 64


def test_runs_stay_equal_after_a_package_was_installed_for_a_while(tmp_path: Path) -> None:
    before = load("smoke")
    with installed(tmp_path, {"toy_problem.py": CORRIDOR}):
        assert run.run_type(None) is not run.run_type("darkroom")
    assert load("smoke") == before and run.run_type(None) is run.run_type(None)
