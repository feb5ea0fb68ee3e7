"""The public names: each is documented, and a user's script with all of them passes ``mypy --strict``."""

import inspect
import re
import subprocess
import sys
from pathlib import Path

import pytest

import icrl_dist

SCRIPT = Path("tests/typing/user_script.py")
CALLABLE = sorted(name for name in icrl_dist.__all__ if callable(getattr(icrl_dist, name)))


@pytest.mark.parametrize("name", [name for name in icrl_dist.__all__ if name != "NULL"])
def test_every_public_name_has_a_docstring_of_its_own(name):
    found = getattr(icrl_dist, name)
    assert found.__doc__ and not found.__doc__.startswith(f"{name}("), "a dataclass without one has its signature"
    if inspect.isclass(found):
        members = {key: value for key, value in vars(found).items() if not key.startswith("_")}
        called = [key for key, value in members.items() if inspect.isfunction(value) or isinstance(value, property)]
        missing = [key for key in called if not inspect.getdoc(getattr(found, key))]
        allowed = {"close", "of", "get", "replace", "episode_return"}  # the name says it all
        assert set(missing) <= allowed, missing


@pytest.mark.parametrize("name", [name for name in CALLABLE if inspect.isfunction(getattr(icrl_dist, name))])
def test_the_docstring_of_a_function_names_its_parameters_and_errors(name):
    function = getattr(icrl_dist, name)
    documented = function.__doc__
    missing = [key for key in inspect.signature(function).parameters if not re.search(rf"\b{key}\b", documented)]
    assert not missing and "Raises" in documented, missing


def test_the_script_uses_every_public_name():
    used = set(re.findall(r"icrl_dist\.(\w+)", SCRIPT.read_text()))
    assert used >= set(icrl_dist.__all__)


def test_the_packages_declare_their_types():
    import tomllib

    data = tomllib.loads(Path("pyproject.toml").read_text())["tool"]["setuptools"]["package-data"]
    for package in ("icrl_dist", "actors", "learner"):
        assert Path(package, "py.typed").is_file() and "py.typed" in data[package]


@pytest.mark.integration
def test_an_import_of_the_package_loads_nothing_heavy():
    script = "import sys, icrl_dist\nprint({'torch', 'ray', 'pandas', 'rich', 'numpy'} & set(sys.modules))"
    ran = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)
    assert ran.stdout.strip() == "set()"


@pytest.mark.integration
@pytest.mark.integration
@pytest.mark.timeout(300)
def test_a_users_script_passes_mypy_strict():
    """With the cache of ``make check`` this takes seconds, without it about half a minute."""
    from mypy import api

    assert re.search(r"^strict = true$", Path("pyproject.toml").read_text(), re.MULTILINE)
    printed, errors, code = api.run(["--config-file", "pyproject.toml", str(SCRIPT)])
    assert (code, errors) == (0, ""), printed
