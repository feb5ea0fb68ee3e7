"""Methods by name."""

from __future__ import annotations

from icrl_dist.config import plugins
from icrl_dist.config.run import Run
from icrl_dist.interfaces import Method


def names() -> tuple[str, ...]:
    """The names of all methods, sorted."""
    return plugins.names("methods")


def of(run: Run) -> Method:
    """A new method object for a run.  Raises ConfigError, with the nearest name, for an unknown method."""
    method: Method = plugins.find("methods", run.method)()
    return method
