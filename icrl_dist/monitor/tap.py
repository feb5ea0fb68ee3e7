"""``icrl-dist tap``: writes trajectories of the monitor plane to standard output, for other programs."""

from __future__ import annotations

import json
import sys
from collections.abc import Callable, Sequence
from typing import Any, Literal

from icrl_dist.config.run import ConfigError
from icrl_dist.stream import monitor_messages, wire
from icrl_dist.types import Identity


class TapWriter:
    """Writes the trajectories that pass the filters, until ``count`` are written or writing fails.

    Invalid messages are ignored.  In JSON, bytes are written as hexadecimal digits.
    """

    def __init__(
        self,
        tasks: Sequence[int],
        adversaries: Sequence[str],
        every: int,
        format: Literal["json", "msgpack"],
        count: int,
        stop: Callable[[], None],
    ) -> None:
        """``adversaries``: numbers of variations, or kinds of adversaries.  ``stop`` is called at the end.

        Raises ConfigError for a number out of range.
        """
        for name, value, least in (("--every", every, 1), ("--count", count, 0), ("--task", min(tasks, default=0), 0)):
            if value < least:
                raise ConfigError(f"{name} {value}: must be at least {least}")
        self._tasks, self._adversaries = set(tasks), set(adversaries)
        self._every, self._format, self._remaining, self._stop = every, format, count, stop
        self._passed = 0
        self._over = False
        self.error: OSError | None = None
        """The error that ended writing, if any; BrokenPipeError if the reader of standard output has closed it."""

    def __call__(self, key: str, payload: bytes) -> None:
        """Take in one message of the monitor plane."""
        try:
            kind, fields = wire.decode_message(payload)
            rows = [row for row in monitor_messages.rows(fields) if self._passes(row)] if kind == "trajectories" else []
        except (wire.WireError, ValueError):
            return
        for row in rows:
            if not self._over:
                self._count_and_write(row)

    def _count_and_write(self, row: dict[str, Any]) -> None:
        self._passed += 1
        if (self._passed - 1) % self._every:
            return
        try:
            self._write(row)
        except ValueError:  # NaN or an infinite number, which JSON does not have
            return
        except OSError as error:
            self.error = error
            self._end()
            return
        self._remaining -= 1
        if self._remaining == 0:
            self._end()

    def _end(self) -> None:
        self._over = True
        self._stop()

    def _write(self, row: dict[str, Any]) -> None:
        if self._format == "msgpack":
            fields = {name: value for name, value in row.items() if name not in ("v", "kind")}
            sys.stdout.buffer.write(wire.encode_message("trajectory", **fields))
        else:
            sys.stdout.write(json.dumps(row, default=bytes.hex, allow_nan=False) + "\n")
        sys.stdout.flush()

    def _passes(self, fields: dict[str, Any]) -> bool:
        """Whether a trajectory passes the filters.  Raises ValueError if it has no identity or adversary."""
        identity, adversary = Identity.parse(str(fields.get("identity"))), fields.get("adversary")
        if not isinstance(adversary, dict):
            raise ValueError("no adversary in the message")
        names = {str(identity.variation), str(adversary.get("kind"))}
        return (not self._tasks or identity.task in self._tasks) and (not self._adversaries or bool(names & self._adversaries))
