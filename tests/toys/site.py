"""Installs a package of another distribution for a test: files and an entry point in a folder on the path."""

from __future__ import annotations

import contextlib
import importlib
import sys
from collections.abc import Iterator
from pathlib import Path

from icrl_dist import version
from icrl_dist.config import plugins, run

CORRIDOR = (Path(__file__).parent / "corridor.py").read_text()
"""Source of a problem."""
SLIPPERY = CORRIDOR.replace("slipped = self.noise[self.h] < self.slip", "slipped = self.noise[self.h] < 2 * self.slip")
"""Another source of it, in which environments differ."""
_CACHES = (version.digest_of, plugins._entries, plugins.find, plugins.sections, plugins.sources, run._packaged)


@contextlib.contextmanager
def installed(site: Path, files: dict[str, str], module: str = "toy_problem", number: str = "1.0") -> Iterator[None]:
    """The distribution ``toys`` with these files, whose problem ``toy`` is the ``CorridorProblem`` of ``module``."""
    info = site / f"toys-{number}.dist-info"
    texts = {
        info / "METADATA": f"Metadata-Version: 2.1\nName: toys\nVersion: {number}\n",
        info / "entry_points.txt": f"[icrl_dist.problems]\ntoy = {module}:CorridorProblem\n",
        **{site / name: text for name, text in files.items()},
    }
    for path, text in texts.items():
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)
    before = set(sys.modules)
    sys.path.insert(0, str(site))
    _forget()
    try:
        yield
    finally:
        sys.path.remove(str(site))
        for name in set(sys.modules) - before:
            if str(getattr(sys.modules[name], "__file__", None) or "").startswith(str(site)):
                del sys.modules[name]
        for name in {module.partition(".")[0]} - before:
            sys.modules.pop(name, None)
        _forget()


def _forget() -> None:
    importlib.invalidate_caches()
    for cache in _CACHES:
        cache.cache_clear()
