"""Find problems and methods of all installed packages by name, through entry points.

A package adds a problem with one line in its ``pyproject.toml``::

    [project.entry-points."icrl_dist.problems"]
    my-problem = "my_package.problem:MyProblem"
"""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import typing
from collections.abc import Iterator, Sequence
from importlib import metadata
from typing import Any, Literal, NamedTuple, get_args

from icrl_dist import version
from icrl_dist.config.toml import ConfigError, nearest
from icrl_dist.stream import schema

Group = Literal["problems", "methods"]


@functools.cache
def _entries(group: Group) -> dict[str, metadata.EntryPoint]:
    found = metadata.entry_points(group=f"icrl_dist.{group}")
    return {entry.name: entry for entry in sorted(found, key=lambda entry: entry.name)}


def names(group: Group) -> tuple[str, ...]:
    """The names of all installed problems or methods, sorted."""
    return tuple(_entries(group))


@functools.cache
def find(group: Group, name: str) -> Any:
    """The class of this name.

    Raises ConfigError if there is none (with the nearest name), if it cannot be imported, or if its section is unsuitable.
    """
    kind = group.removesuffix("s")
    if name not in names(group):
        known = f"choose one of {', '.join(names(group))}"
        raise ConfigError(f"{kind} = {name!r}{nearest(name, names(group))}: {known}")
    try:
        owner = _entries(group)[name].load()
    except Exception as error:  # whatever another package's module raises while it is imported
        raise ConfigError(f"{kind} = {name!r}: its package cannot be imported ({error}); reinstall that package") from None
    try:
        if owner.section or group == "problems":
            _check_section(owner.Config)
    except Exception as error:  # whatever the class, its annotations and defaults raise
        raise ConfigError(f"{kind} = {name!r}: section [{getattr(owner, 'section', '')}], {error}") from None
    return owner


def _check_section(cls: Any) -> None:
    """Raises an error if a run file cannot hold this section, or if it cannot be hashed, which the cache of problems needs."""
    if not dataclasses.is_dataclass(cls) or cls.__hash__ is None:
        raise TypeError(f"class {cls.__name__}: use @dataclass(frozen=True)")
    for name, hint in _fields(cls).items():
        for part in _classes(hint):
            if part.__hash__ is None:
                raise TypeError(
                    f"field {name}: a {part.__name__} can change, so it has no hash; use a tuple or a frozen dataclass"
                )
    schema.check(typing.cast(Any, cls)())  # each field has a type that can be decoded, and a default in its range


def _fields(cls: Any) -> dict[str, Any]:
    """The types of a dataclass's fields; class variables are no fields."""
    hints = typing.get_type_hints(cls)
    return {item.name: hints[item.name] for item in dataclasses.fields(cls)}


def _classes(hint: Any) -> Iterator[type]:
    """The classes in a type annotation, those of a dataclass's fields included."""
    origin = typing.get_origin(hint) or hint
    if isinstance(origin, type):
        yield origin
    fields = _fields(hint).values() if dataclasses.is_dataclass(hint) else ()
    for part in (*typing.get_args(hint), *fields):
        yield from _classes(part)


def importable(group: Group) -> dict[str, Any]:
    """The classes of all problems or methods by name, without those whose package cannot be imported."""
    found = {}
    for name in names(group):
        with contextlib.suppress(ConfigError):
            found[name] = find(group, name)
    return found


class Source(NamedTuple):
    """The distribution that has a problem or a method of another package, and the digest of its code."""

    distribution: str
    version: str
    code: str
    """``version.digest_of`` its module."""


@functools.cache
def sources() -> dict[str, Source]:
    """The source of every installed problem and method of another package, by ``problems/NAME`` or ``methods/NAME``.

    Problems and methods of this package are left out.  No package is imported, so one that is broken is here too.
    """
    found = {}
    for group in get_args(Group):
        for name, entry in _entries(group).items():
            if entry.module.partition(".")[0] not in version.PACKAGES:
                distribution = (entry.dist.name, entry.dist.version) if entry.dist else ("", "")
                found[f"{group}/{name}"] = Source(*distribution, version.digest_of(entry.module))
    return found


def of_run(problem: str, method: str) -> dict[str, str]:
    """The names in ``sources`` that a run of this problem and method may have, with their text for messages."""
    return {f"problems/{problem}": f"problem {problem!r}", f"methods/{method}": f"method {method!r}"}


def text(source: Sequence[str] | None) -> str:
    """A source, or its fields, for messages; None: the problem or method is not one of another package."""
    return f"{source[0]} {source[1]} with code {source[2][:8]}" if source else "no other package with it"


@functools.cache
def sections(problem: str | None) -> dict[str, type]:
    """The sections that a problem and the installed methods add to a run file: dataclass by name.

    With None the sections of all problems.  A package that cannot be imported adds none, unless it is the problem's.
    Raises ConfigError if two dataclasses share a section's name.
    """
    owners = list(importable("problems").values()) if problem is None else [find("problems", problem)]
    owners += [method for method in importable("methods").values() if method.section]
    found: dict[str, type] = {}
    for owner in owners:
        if found.setdefault(owner.section, owner.Config) is not owner.Config:
            raise ConfigError(f"section [{owner.section}] belongs to {found[owner.section].__module__} and {owner.__module__}")
    return found
