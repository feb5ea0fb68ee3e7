"""The monitor plane as lines on standard output, for other programs."""

from __future__ import annotations

import json
import sys
from collections.abc import Callable, Sequence
from typing import Any, Literal

from icrl_dist.config.run import ConfigError
from icrl_dist.stream import monitor_messages, wire
from icrl_dist.types import Identity


class TapWriter:
    """Writes the trajectories that pass, until there are enough or they cannot be written.

    A message that is none is left out.  In JSON, bytes are hexadecimal digits.
    """

    def __init__(
        self,
        tasks: Sequence[int],
        adversaries: Sequence[str],
        every: int,
        format: Literal["json", "msgpack"],
        count: int,
        enough: Callable[[], None],
    ) -> None:
        """``adversaries``: numbers of variations, or kinds.  Raises ConfigError for numbers that cannot be."""
        for name, value, least in (("--every", every, 1), ("--count", count, 0), ("--task", min(tasks, default=0), 0)):
            if value < least:
                raise ConfigError(f"{name} {value}: must be at least {least}")
        self._tasks, self._adversaries = set(tasks), set(adversaries)
        self._every, self._format, self._left, self._enough = every, format, count, enough
        self._passed = 0
        self._over = False
        self.error: OSError | None = None
        """Why it could write no more, if so; BrokenPipeError once nobody reads."""

    def __call__(self, key: str, payload: bytes) -> None:
        """One message of the monitor plane."""
        try:
            kind, fields = wire.decode_message(payload)
            told = [one for one in monitor_messages.rows(fields) if self._passes(one)] if kind == "trajectories" else []
        except (wire.WireError, ValueError):
            return
        for one in told:
            if not self._over:
                self._take(one)

    def _take(self, one: dict[str, Any]) -> None:
        self._passed += 1
        if (self._passed - 1) % self._every:
            return
        try:
            self._write(one)
        except OSError as error:
            self.error = error
            self._end()
            return
        self._left -= 1
        if self._left == 0:
            self._end()

    def _end(self) -> None:
        self._over = True
        self._enough()

    def _write(self, one: dict[str, Any]) -> None:
        if self._format == "msgpack":
            fields = {name: value for name, value in one.items() if name not in ("v", "kind")}
            sys.stdout.buffer.write(wire.encode_message("trajectory", **fields))
        else:
            sys.stdout.write(json.dumps(one, default=bytes.hex) + "\n")
        sys.stdout.flush()

    def _passes(self, fields: dict[str, Any]) -> bool:
        """Raises ValueError for a message that names no trajectory."""
        identity, adversary = Identity.parse(str(fields.get("identity"))), fields.get("adversary")
        if not isinstance(adversary, dict):
            raise ValueError("no adversary")
        names = {str(identity.variation), str(adversary.get("kind"))}
        return (not self._tasks or identity.task in self._tasks) and (not self._adversaries or bool(names & self._adversaries))
