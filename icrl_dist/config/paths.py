"""Paths that users pass to public functions."""

from __future__ import annotations

import os
from pathlib import Path

from icrl_dist.arrays import short
from icrl_dist.config.toml import ConfigError


def path_of(name: str, value: object) -> Path:
    """The path.  Raises ConfigError, with the argument's ``name``, unless it is text that is not empty, or a ``Path``."""
    if not isinstance(value, str | os.PathLike) or not isinstance(text := os.fspath(value), str) or not text:
        raise ConfigError(f"{name} = {short(value)}: expected a path, as text that is not empty or a pathlib.Path")
    try:
        Path(text).exists()
    except OSError as error:
        raise ConfigError(f"{name} = {short(text)}: cannot be a path here ({error.strerror}); name another") from None
    return Path(text)


def folder_of(name: str, value: object) -> Path:
    """The path of a run folder.  Raises ConfigError unless there is a folder; ``name``: the argument's."""
    folder = path_of(name, value)
    if folder.exists() and not folder.is_dir():
        raise ConfigError(f"{folder}: is a file; name a run folder, such as runs/demo")
    if not folder.is_dir():
        raise ConfigError(f"{folder}: no such run folder; `icrl-dist train demo` makes one in runs/demo")
    return folder
