"""An agent's own number of torch threads, while it computes, and the check of such settings."""

from __future__ import annotations

import contextlib
import os
import sys
import threading
from collections.abc import Iterator
from typing import Any

from icrl_dist.arrays import whole
from icrl_dist.config.run import ConfigError


def whole_or_none(name: str, value: Any, least: int) -> int | None:
    """A whole number of at least ``least``, or None.  Raises ConfigError for another value."""
    try:
        return None if value is None else whole(name, value, least)
    except ValueError as error:
        raise ConfigError(f"{error}, or None") from None


_entering = threading.Lock()
_inside = 0
_before = 0


def _forget() -> None:
    """In a forked process no other thread computes."""
    global _entering, _inside
    _entering, _inside = threading.Lock(), 0


os.register_at_fork(after_in_child=_forget)


@contextlib.contextmanager
def torch_threads(count: int | None) -> Iterator[None]:
    """Let torch use this many threads; afterwards the process's own number again.  None: that number.

    Nothing happens in a process that has not imported torch.  A thread that enters while another is inside would read the
    other's number as the process's: the first reads it for all.
    """
    global _inside, _before
    if count is None or "torch" not in sys.modules:
        yield
        return
    import torch

    with _entering:
        _before = _before if _inside else torch.get_num_threads()
        _inside, before = _inside + 1, _before
        torch.set_num_threads(count)
    try:
        yield
    finally:
        with _entering:
            _inside -= 1
            torch.set_num_threads(before)
