"""Convert dataclasses to TOML and back, strictly."""

from __future__ import annotations

from typing import Any

import tomli_w

from icrl_dist.stream import schema
from icrl_dist.stream.excerpts import nearest

__all__ = ["ConfigError", "build", "dumps", "nearest"]


class ConfigError(ValueError):
    """An impossible setting.  The message is one line: where, the value, the remedy."""


def dumps(config: object) -> str:
    """A dataclass of at most two levels as TOML; ``build`` restores an equal value from it."""
    return tomli_w.dumps(schema.as_data(config))


def build(cls: type, table: dict[str, Any], source: str) -> object:
    """Make a ``cls`` from a TOML table.

    Raises ConfigError, beginning with ``source``, for an unknown key, a wrong type or a value out of range.
    """
    try:
        return schema.read(cls, table)
    except schema.Invalid as error:
        raise ConfigError(f"{source}: {error}") from None
