"""SHA-256 of code, installed or in a wheel: it identifies the code that a process runs."""

from __future__ import annotations

import functools
import hashlib
import importlib.util
import zipfile
from collections.abc import Iterable
from pathlib import Path

PACKAGES = ("icrl_dist", "actors", "learner")
_SUFFIXES = (".c", ".h", ".py", ".toml")


@functools.cache
def digest() -> str:
    """SHA-256 of the code that this process imports, hex."""
    above = Path(__file__).parents[1]
    files = [file for package in PACKAGES for suffix in _SUFFIXES for file in (above / package).rglob(f"*{suffix}")]
    return _digest((file.relative_to(above).as_posix(), file.read_bytes()) for file in files)


@functools.cache
def digest_of(module: str) -> str:
    """SHA-256 of the source files of the top-level package that holds a module, hex; of the file alone for a loose module.

    Of packages without ``__init__.py``, which several distributions may share, the next package below counts.
    Empty if there is no such module.  Nothing of the package is executed.
    """
    names = module.split(".")
    try:
        specs = (importlib.util.find_spec(".".join(names[: count + 1])) for count in range(len(names)))
        spec = next((one for one in specs if one is None or one.origin is not None), None)
    except (ImportError, ValueError):
        return ""
    if spec is None or spec.origin is None or not spec.has_location:  # a module of Python itself may have no file
        return ""
    if spec.submodule_search_locations is None:
        file = Path(spec.origin)
        return _digest([(file.name, file.read_bytes())])
    files = [
        (file.relative_to(folder).as_posix(), file.read_bytes())
        for folder in spec.submodule_search_locations
        for suffix in _SUFFIXES
        for file in Path(folder).rglob(f"*{suffix}")
    ]
    return _digest(files)


def digest_of_wheel(wheel: Path) -> str:
    """SHA-256 of the code in a wheel, hex.  Raises OSError or zipfile.BadZipFile if it cannot be read."""
    with zipfile.ZipFile(wheel) as archive:
        names = [n for n in archive.namelist() if n.split("/")[0] in PACKAGES and n.endswith(_SUFFIXES)]
        return _digest((name, archive.read(name)) for name in names)


def _digest(files: Iterable[tuple[str, bytes]]) -> str:
    whole = hashlib.sha256()
    for name, content in sorted(files):
        whole.update(f"{name}\0{len(content)}\0".encode() + content)
    return whole.hexdigest()
