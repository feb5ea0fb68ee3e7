"""A problem and a method of another package, 60 lines each: all that a newcomer would write."""

import contextlib
from importlib import metadata
from types import SimpleNamespace

from icrl_dist.config import plugins, run
from icrl_dist.problems import registry


@contextlib.contextmanager
def installed(patch, **groups):
    """As if a package with these entry points were installed: ``problems={name: class}``, ``methods={name: class}``.

    ``patch``: a ``pytest.MonkeyPatch``.  A string in place of a class is an entry point, ``module:class``.
    """
    caches = (plugins.find, plugins.sections, plugins.sources, run._packaged, registry.problem)
    entries = plugins._entries

    def entry(group, name, made):
        if isinstance(made, str):
            return metadata.EntryPoint(name, made, f"icrl_dist.{group}")
        return SimpleNamespace(name=name, module=made.__module__, dist=None, load=lambda: made)

    def with_toys(group):
        return {**entries(group), **{name: entry(group, name, made) for name, made in groups.get(group, {}).items()}}

    with patch.context() as during:
        during.setattr(plugins, "_entries", with_toys)
        for cache in caches:
            cache.cache_clear()
        yield
    for cache in caches:
        cache.cache_clear()
