"""Former names of sections and keys of the run file.

A run file of a user is refused with the present name.  What an older version of this program wrote (``run.toml`` in
a run folder, the settings in a checkpoint or in ``fork.json``) is translated.
"""

from __future__ import annotations

from collections.abc import Set
from typing import Any

from icrl_dist.config import plugins
from icrl_dist.config.toml import ConfigError

RENAMED = {
    "practice": "dagger",
    "model.stretch": "model.window",
    "pretrain.stretches": "pretrain.windows",
    "pretrain.misled": "pretrain.decoy_fraction",
    "pretrain.behaviours": "pretrain.behaviors",
    "optim.stretches": "optim.windows",
}
"""Former names of sections and keys, and the present ones."""


def check(tables: dict[str, Any], sections: Set[str], problem: object, source: str) -> None:
    """Check the names in a user's run file or flags; ``sections``: the names that this problem's run file may have.

    Raises ConfigError for a former name, with the present one, and for a section of other problems, with their names.
    """
    for old, new in RENAMED.items():
        section, _, key = old.partition(".")
        table = tables.get(section)
        if (not key and section in tables) or (isinstance(table, dict) and key in table):
            raise ConfigError(f"{source}: {old} is now called {new}: rename it")
    for name in tables:
        if name not in sections and name in plugins.sections(None):
            owners = _owners(name)
            raise ConfigError(
                f"{source}: section [{name}]: problem = {problem!r} has no such section, it belongs to {owners}; leave it out"
            )


def _disturbances_counted(tables: dict[str, Any]) -> dict[str, Any]:
    """Files without ``adversary.null`` counted phi_0, which every task had, as one of ``adversary.count``."""
    adversary = tables.get("adversary")
    if not isinstance(adversary, dict) or "null" in adversary or type(adversary.get("count")) is not int:
        return tables
    return {**tables, "adversary": {**adversary, "count": adversary["count"] - 1, "null": True}}


def _ignored(tables: dict[str, Any]) -> dict[str, Any]:
    """Method icaa ignored ``dagger.rounds``, which is refused now."""
    dagger = tables.get("dagger")
    if tables.get("method") != "icaa" or not isinstance(dagger, dict):
        return tables
    return {**tables, "dagger": {**dagger, "rounds": 0}}


def _owners(section: str) -> str:
    owners = [name for name, owner in plugins.importable("problems").items() if owner.section == section]
    return owners[0] + (f" and {len(owners) - 1} other problems" if len(owners) > 1 else "")


def translated(tables: dict[str, Any], sections: Set[str], owner: Any) -> dict[str, Any]:
    """The settings that an older version wrote, with present names and without sections of other problems.

    ``owner``: the class of the problem, which translates the values of its own section.
    """
    found = {name: dict(table) if isinstance(table, dict) else table for name, table in tables.items()}
    for old, new in RENAMED.items():
        section, _, key = old.partition(".")
        holder = found.get(section) if key else found
        if isinstance(holder, dict) and (key or section) in holder:
            holder[new.rpartition(".")[2]] = holder.pop(key or section)
    found = owner.translated(_disturbances_counted(_ignored(found)))
    unknown = found.keys() - sections
    foreign = unknown & plugins.sections(None).keys() if unknown else set()  # they take the import of every problem
    return {name: table for name, table in found.items() if name not in foreign}
