"""Files of the user that hide modules: Python finds a file ``random.py`` before its own module ``random``."""

from __future__ import annotations

import itertools
import sys
import sysconfig
from collections.abc import Iterable
from importlib import metadata
from pathlib import Path

from packaging.requirements import Requirement

from icrl_dist import version
from icrl_dist.diagnostics.checks import Check

ROOT = Path(version.__file__).parents[1]
"""The folder that holds this package."""


def hidden_packages() -> dict[str, Path]:
    """The packages of this distribution in place of which this process imports something else, and its file."""
    found = {}
    for name in version.PACKAGES:
        file = next(iter(_files(_places(sys.path), name)), None)
        if file is not None and ROOT not in file.parents:
            found[name] = file
    return found


def check_modules() -> Check:
    """Whether a file in this process's search path, or in the current folder, has the name of a module that a run needs."""
    name, here = "module names", Path.cwd()
    names = sorted(sys.stdlib_module_names | _needed())
    installed = Path(sysconfig.get_path("purelib"))
    places = itertools.takewhile(lambda place: not (place / "os.py").is_file(), _places(sys.path))  # those before the library
    own = [place for place in places if place != ROOT and installed not in (place, *place.parents)]
    if hiding := [file for one in names for file in _files(own, one)]:
        value = f"{hiding[0]} hides the module {_module(hiding[0])}"
        return Check(name, False, value, "rename it, or take its folder out of PYTHONPATH")
    if here != ROOT and (beside := [file for one in names for file in _files([here], one)]):
        value = f"{beside[0].relative_to(here)} in this folder hides the module {_module(beside[0])} from your own scripts"
        return Check(name, None, value, "rename it, or start Python with -P; the command icrl-dist does not search this folder")
    return Check(name, True, "no file hides a module")


def _places(path: Iterable[str]) -> list[Path]:
    return [Path(place).absolute() for place in path]


def _files(places: Iterable[Path], name: str) -> list[Path]:
    """The files in these places that ``import NAME`` would take."""
    files = (file for place in places for file in (place / name / "__init__.py", place / f"{name}.py"))
    return [file for file in files if file.is_file()]


def _module(file: Path) -> str:
    return file.parent.name if file.name == "__init__.py" else file.stem


def _needed() -> set[str]:
    """Names of the packages of this distribution and of those that it requires."""
    required = {Requirement(text).name for text in metadata.requires("icrl-dist") or ()}
    owners = metadata.packages_distributions().items()
    return {*version.PACKAGES, *(name for name, dists in owners if required & set(dists) and not name.startswith("_"))}
