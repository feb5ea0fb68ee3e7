"""TOML tables and frozen dataclasses: strict both ways, every complaint with a place and a remedy."""

from __future__ import annotations

import dataclasses
import difflib
import json
import types
import typing
from collections.abc import Sequence
from typing import Any, Literal


class ConfigError(ValueError):
    """A value that a run cannot have: what, where, and the remedy, on one line."""


def dumps(config: Any) -> str:
    """A dataclass, two levels deep, as TOML that ``build`` reads back to an equal value."""
    lines: list[str] = []
    tables: list[str] = []
    for item in dataclasses.fields(config):
        value = getattr(config, item.name)
        if dataclasses.is_dataclass(value):
            rows = [f"{f.name} = {_toml(getattr(value, f.name))}" for f in dataclasses.fields(value)]
            tables.append("\n".join([f"[{item.name}]", *rows]))
        else:
            lines.append(f"{item.name} = {_toml(value)}")
    return "\n".join(lines) + "\n\n" + "\n\n".join(tables) + "\n"


def _toml(value: object) -> str:
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, str):
        return json.dumps(value, ensure_ascii=False)
    if isinstance(value, tuple):
        return "[" + ", ".join(map(_toml, value)) + "]"
    return repr(value)


def nearest(name: str, known: Sequence[str]) -> str:
    """``; did you mean 'x'?`` where a known name is near."""
    close = difflib.get_close_matches(name, known, n=1)
    return f"; did you mean {close[0]!r}?" if close else ""


def build(cls: type, table: dict[str, Any], source: str, prefix: str = "") -> object:
    """``cls`` from a TOML table.  Raises ConfigError for an unknown key or a wrong type."""
    hints = typing.get_type_hints(cls)
    for key in table:
        if key not in hints:
            known = list(hints)
            raise ConfigError(f"{source}: unknown key {prefix}{key}{nearest(key, known)}; known keys here: {', '.join(known)}")
    values = {key: _value(hints[key], value, source, prefix + key) for key, value in table.items()}
    try:
        return cls(**values)
    except ConfigError as error:
        raise ConfigError(f"{source}: {error}") from None


def _value(hint: Any, value: Any, source: str, where: str) -> Any:
    if dataclasses.is_dataclass(hint):
        if not isinstance(value, dict):
            raise ConfigError(f"{source}: {where} = {value!r}: expected a table [{where}]")
        return build(typing.cast(type, hint), value, source, where + ".")
    origin = typing.get_origin(hint)
    if origin is Literal:
        if value not in typing.get_args(hint):
            choices = ", ".join(map(repr, typing.get_args(hint)))
            raise ConfigError(f"{source}: {where} = {value!r}: choose one of {choices}")
        return value
    if origin is tuple:
        if not isinstance(value, list):
            raise ConfigError(f"{source}: {where} = {value!r}: expected a list")
        return tuple(_value(typing.get_args(hint)[0], v, source, where) for v in value)
    if origin is types.UnionType:  # float | str: a whole number is a float
        kinds = typing.get_args(hint)
        named = " or ".join(kind.__name__ for kind in kinds)
        whole = float in kinds and type(value) is int
        if not whole and type(value) not in kinds:
            raise ConfigError(f"{source}: {where} = {value!r}: expected {named}, got {type(value).__name__}")
        return float(value) if whole else value
    if hint is float and isinstance(value, int) and not isinstance(value, bool):
        return float(value)
    if type(value) is not hint:
        raise ConfigError(f"{source}: {where} = {value!r}: expected {hint.__name__}, got {type(value).__name__}")
    return value
