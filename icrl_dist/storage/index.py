"""The ledger: a row a trajectory, derived from the segments each time they are opened.

It lives in a temporary database, so it cannot disagree with the segments, takes no memory that
grows with the dataset, and a stranger's run brings none of its own.
"""

from __future__ import annotations

import sqlite3
import threading
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

from icrl_dist.stream import wire
from icrl_dist.types import STAGES, Identity, Trajectory

_KEY = "stage, round, task, variation, trial"
_COLUMNS = f"{_KEY}, segment, offset, length, weights, digest, worker, origin, sha256"


@dataclass(frozen=True, slots=True)
class Row:
    """What is known of a stored trajectory."""

    identity: Identity
    segment: int
    """Number of the segment it lies in."""
    offset: int
    """Byte at which its payload begins."""
    length: int
    """Bytes of its payload."""
    policy_version: int
    """Version of the weights that acted; -1 for a policy without weights."""
    weights_digest: str
    """Digest of those weights."""
    worker: str
    origin: str
    """Where its labels came from."""
    sha256: str
    """Of every array and label byte, identity and variation: the same whoever made it."""

    @classmethod
    def of(cls, trajectory: Trajectory, segment: int, offset: int, length: int) -> Row:
        t = trajectory
        return cls(
            t.identity,
            segment,
            offset,
            length,
            t.policy_version,
            t.weights_digest,
            t.worker,
            t.origin,
            wire.trajectory_digest(t),
        )


class Ledger:
    """Rows by identity, in canonical order; safe to use from several threads."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._length = 0
        self._database = sqlite3.connect("", check_same_thread=False, isolation_level=None)  # a temporary file
        for pragma in ("journal_mode = OFF", "synchronous = OFF"):
            self._database.execute(f"PRAGMA {pragma}")
        self._database.execute(f"CREATE TABLE ledger ({_COLUMNS}, PRIMARY KEY ({_KEY})) WITHOUT ROWID")

    def enter(self, rows: Iterable[Row]) -> None:
        """Take rows in; a second row of the same identity is ignored."""
        values = (
            (
                *r.identity.key(),
                r.segment,
                r.offset,
                r.length,
                r.policy_version,
                r.weights_digest,
                r.worker,
                r.origin,
                bytes.fromhex(r.sha256),
            )
            for r in rows
        )
        with self._lock:
            self._database.execute("BEGIN")
            made = self._database.executemany(f"INSERT OR IGNORE INTO ledger VALUES ({'?, ' * 12}?)", values)
            self._database.execute("COMMIT")
            self._length += made.rowcount

    def drop(self, key: tuple[str, int, int, int]) -> None:
        """Leave a variation's trajectories out, as if they were not stored."""
        with self._lock:
            where = "(stage, round, task, variation) = (?, ?, ?, ?)"
            self._length -= self._database.execute(f"DELETE FROM ledger WHERE {where}", _variation(key)).rowcount

    def close(self) -> None:
        with self._lock:
            self._database.close()

    def __contains__(self, identity: Identity) -> bool:
        return bool(self._all(f"SELECT 1 FROM ledger WHERE ({_KEY}) = (?, ?, ?, ?, ?)", identity.key()))

    def __len__(self) -> int:
        """Kept, not counted: progress asks for it four times a second."""
        return self._length

    def __iter__(self) -> Iterator[Row]:
        return map(_row, self._each(f"SELECT {_COLUMNS} FROM ledger ORDER BY {_KEY}"))

    def __getitem__(self, identity: Identity) -> Row:
        """Raises KeyError if there is no such trajectory."""
        found = self._all(f"SELECT {_COLUMNS} FROM ledger WHERE ({_KEY}) = (?, ?, ?, ?, ?)", identity.key())
        if not found:
            raise KeyError(identity)
        return _row(found[0])

    def variations(self, stage: str, round: int) -> list[tuple[str, int, int, int]]:
        """Which variations of one stage and round there are: (stage, round, task, variation)."""
        sql = f"SELECT DISTINCT task, variation FROM ledger WHERE stage = ? AND round = ? ORDER BY {_KEY}"
        return [(stage, round, task, variation) for task, variation in self._all(sql, _phase(stage, round))]

    def trials(self, key: tuple[str, int, int, int]) -> list[Row]:
        """The rows of one variation, in order of trial."""
        where = "(stage, round, task, variation) = (?, ?, ?, ?)"
        return [*map(_row, self._all(f"SELECT {_COLUMNS} FROM ledger WHERE {where} ORDER BY {_KEY}", _variation(key)))]

    def identities(self, stage: str, round: int, tasks: tuple[int, int]) -> list[Identity]:
        """Those of one stage and round, from the first task to before the second."""
        where = "stage = ? AND round = ? AND task >= ? AND task < ?"
        found = self._all(f"SELECT {_KEY} FROM ledger WHERE {where} ORDER BY {_KEY}", (*_phase(stage, round), *tasks))
        return [_identity(key) for key in found]

    def count(self, stage: str, round: int) -> int:
        """How many there are of one stage and round."""
        return int(self._all("SELECT COUNT(*) FROM ledger WHERE stage = ? AND round = ?", _phase(stage, round))[0][0])

    def acted(self, stage: str, round: int, tasks: tuple[int, int]) -> list[int]:
        """Versions of the weights that acted in some of these tasks."""
        where = "stage = ? AND round = ? AND task >= ? AND task < ?"
        return [w for (w,) in self._all(f"SELECT DISTINCT weights FROM ledger WHERE {where}", (*_phase(stage, round), *tasks))]

    def lags(self) -> dict[int, int]:
        """How many trajectories of the adapting rounds j were made by T^(j - lag), by lag; 0 only, unless rounds overlap."""
        where = f"stage = {STAGES.index('adapt')}"
        return dict(self._all(f"SELECT round - weights AS lag, COUNT(*) FROM ledger WHERE {where} GROUP BY lag ORDER BY lag"))

    def digests(self, version: int | None = None) -> Iterator[str]:
        """Every trajectory's SHA-256, in canonical order; only of those that T^version was fitted to, if given."""
        where = "1" if version is None else f"stage = {STAGES.index('pretrain')} OR round < {int(version)}"
        return (sha256.hex() for (sha256,) in self._each(f"SELECT sha256 FROM ledger WHERE {where} ORDER BY {_KEY}"))

    def _all(self, sql: str, values: Sequence[object] = ()) -> list[Any]:
        with self._lock:
            return self._database.execute(sql, values).fetchall()

    def _each(self, sql: str, values: Sequence[object] = ()) -> Iterator[Any]:
        """Rows a thousand at a time, for there may be more than memory holds."""
        with self._lock:
            cursor = self._database.execute(sql, values)
        while True:
            with self._lock:
                rows = cursor.fetchmany(1000)
            if not rows:
                return
            yield from rows


def _phase(stage: str, round: int) -> tuple[int, int]:
    return STAGES.index(stage), round


def _variation(key: tuple[str, int, int, int]) -> tuple[int, ...]:
    return (STAGES.index(key[0]), *key[1:])


def _identity(key: Sequence[Any]) -> Identity:
    return Identity(STAGES[key[0]], *key[1:])


def _row(found: Sequence[Any]) -> Row:
    number, offset, length, weights, digest, worker, origin, sha256 = found[5:]
    return Row(_identity(found[:5]), number, offset, length, weights, digest, worker, origin, sha256.hex())
