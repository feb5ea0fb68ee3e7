"""SHA-256 of the package's code, installed or in a wheel: it identifies the code that a process runs."""

from __future__ import annotations

import functools
import hashlib
import zipfile
from collections.abc import Iterable
from pathlib import Path

PACKAGES = ("icrl_dist", "actors", "learner")
_SUFFIXES = (".py", ".toml")


@functools.cache
def digest() -> str:
    """SHA-256 of the code that this process imports, hex."""
    above = Path(__file__).parents[1]
    files = [file for package in PACKAGES for suffix in _SUFFIXES for file in (above / package).rglob(f"*{suffix}")]
    return _digest((file.relative_to(above).as_posix(), file.read_bytes()) for file in files)


@functools.cache
def digest_of(parts: tuple[str, ...]) -> str:
    """SHA-256 of some modules in ``icrl_dist``, hex.  ``parts``: files, or folders (ending in ``/``) with all their files."""
    root = Path(__file__).parent
    files = [found for part in parts for found in ((root / part).rglob("*.py") if part.endswith("/") else [root / part])]
    return _digest((found.relative_to(root).as_posix(), found.read_bytes()) for found in files)


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
