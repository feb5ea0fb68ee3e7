"""TOML tables and frozen dataclasses: strict both ways, every complaint with a place and a remedy."""

from __future__ import annotations

from typing import Any

import tomli_w

from icrl_dist.stream import schema
from icrl_dist.stream.excerpts import nearest

__all__ = ["ConfigError", "build", "dumps", "nearest"]


class ConfigError(ValueError):
    """A value that a run cannot have: what, where, and the remedy, on one line."""


def dumps(config: object) -> str:
    """A dataclass, two levels deep, as TOML that ``build`` reads back to an equal value."""
    return tomli_w.dumps(schema.as_data(config))


def build(cls: type, table: dict[str, Any], source: str) -> object:
    """``cls`` from a TOML table.

    Raises ConfigError, naming ``source``, for an unknown key, a wrong type or a value out of range.
    """
    try:
        return schema.read(cls, table)
    except schema.Invalid as error:
        raise ConfigError(f"{source}: {error}") from None
