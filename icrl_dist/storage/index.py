"""The index of a dataset: one row a trajectory, built from the segments each time they are opened.

It is a temporary SQLite database.  So it always agrees with the segments, its memory does not grow
with the dataset, and no database file of an untrusted run is ever opened.
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
_COLUMNS = f"{_KEY}, segment, offset, length, policy_version, weights_digest, worker, origin, sha256"


@dataclass(frozen=True, slots=True)
class Row:
    """The index entry of a stored trajectory."""

    identity: Identity
    segment: int
    """Number of its segment."""
    offset: int
    """First byte of its payload."""
    length: int
    """Bytes of its payload."""
    policy_version: int
    """Weights version of the policy; -1 for a policy without weights."""
    weights_digest: str
    """Digest of those weights."""
    worker: str
    origin: str
    """Source of its labels."""
    sha256: str
    """``wire.trajectory_digest``."""

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


class Index:
    """Rows by identity, in canonical order.  Safe to use from several threads."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._length = 0
        self._database = sqlite3.connect("", check_same_thread=False, isolation_level=None)  # a temporary file
        for pragma in ("journal_mode = OFF", "synchronous = OFF"):
            self._database.execute(f"PRAGMA {pragma}")
        self._database.execute(f"CREATE TABLE trajectories ({_COLUMNS}, PRIMARY KEY ({_KEY})) WITHOUT ROWID")

    def add(self, rows: Iterable[Row]) -> None:
        """Add rows; a second row of the same identity is ignored."""
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
            added = self._database.executemany(f"INSERT OR IGNORE INTO trajectories VALUES ({'?, ' * 12}?)", values)
            self._database.execute("COMMIT")
            self._length += added.rowcount

    def drop(self, key: tuple[str, int, int, int]) -> None:
        """Remove the rows of a variation, as if its trajectories were not stored."""
        with self._lock:
            where = "(stage, round, task, variation) = (?, ?, ?, ?)"
            self._length -= self._database.execute(f"DELETE FROM trajectories WHERE {where}", _variation(key)).rowcount

    def close(self) -> None:
        with self._lock:
            self._database.close()

    def __contains__(self, identity: Identity) -> bool:
        return bool(self._all(f"SELECT 1 FROM trajectories WHERE ({_KEY}) = (?, ?, ?, ?, ?)", identity.key()))

    def __len__(self) -> int:
        """The number of rows, kept up to date because progress reports read it four times a second."""
        return self._length

    def __iter__(self) -> Iterator[Row]:
        return map(_row, self._each(f"SELECT {_COLUMNS} FROM trajectories ORDER BY {_KEY}"))

    def __getitem__(self, identity: Identity) -> Row:
        """The row of this identity.  Raises KeyError if there is none."""
        found = self._all(f"SELECT {_COLUMNS} FROM trajectories WHERE ({_KEY}) = (?, ?, ?, ?, ?)", identity.key())
        if not found:
            raise KeyError(identity)
        return _row(found[0])

    def variations(self, stage: str, round: int) -> list[tuple[str, int, int, int]]:
        """The variations of one stage and round that have rows: (stage, round, task, variation)."""
        sql = f"SELECT DISTINCT task, variation FROM trajectories WHERE stage = ? AND round = ? ORDER BY {_KEY}"
        return [(stage, round, task, variation) for task, variation in self._all(sql, _phase(stage, round))]

    def trials(self, key: tuple[str, int, int, int]) -> list[Row]:
        """The rows of one variation, in order of trial."""
        where = "(stage, round, task, variation) = (?, ?, ?, ?)"
        return [*map(_row, self._all(f"SELECT {_COLUMNS} FROM trajectories WHERE {where} ORDER BY {_KEY}", _variation(key)))]

    def identities(self, stage: str, round: int, tasks: tuple[int, int]) -> list[Identity]:
        """The identities of one stage and round with ``tasks[0] <= task < tasks[1]``."""
        where = "stage = ? AND round = ? AND task >= ? AND task < ?"
        found = self._all(f"SELECT {_KEY} FROM trajectories WHERE {where} ORDER BY {_KEY}", (*_phase(stage, round), *tasks))
        return [_identity(key) for key in found]

    def count(self, stage: str, round: int) -> int:
        """The number of rows of one stage and round."""
        return int(self._all("SELECT COUNT(*) FROM trajectories WHERE stage = ? AND round = ?", _phase(stage, round))[0][0])

    def policy_versions(self, stage: str, round: int, tasks: tuple[int, int]) -> list[int]:
        """The weights versions of the policies in tasks ``tasks[0] <= task < tasks[1]``."""
        where = "stage = ? AND round = ? AND task >= ? AND task < ?"
        return [
            version
            for (version,) in self._all(
                f"SELECT DISTINCT policy_version FROM trajectories WHERE {where}", (*_phase(stage, round), *tasks)
            )
        ]

    def made_by(self) -> list[tuple[int, str, Identity]]:
        """The policy versions with their weights digests that made trajectories, each with the first such trajectory."""
        found = self._all(
            f"SELECT {_KEY}, policy_version, weights_digest FROM trajectories WHERE policy_version >= 0 "
            f"GROUP BY policy_version, weights_digest ORDER BY {_KEY}"
        )
        return [(row[5], row[6], _identity(row[:5])) for row in found]

    def lags(self) -> dict[int, int]:
        """The number of trajectories of adaptation rounds j made by T^(j - lag), by lag; only 0 unless rounds overlap."""
        where = f"stage = {STAGES.index('adapt')}"
        return dict(
            self._all(
                f"SELECT round - policy_version AS lag, COUNT(*) FROM trajectories WHERE {where} GROUP BY lag ORDER BY lag"
            )
        )

    def digests(self, version: int | None = None) -> Iterator[str]:
        """Every trajectory's SHA-256, in canonical order; with ``version``, only of the data that T^version was fitted to."""
        where = "1" if version is None else f"stage = {STAGES.index('pretrain')} OR round < {int(version)}"
        return (sha256.hex() for (sha256,) in self._each(f"SELECT sha256 FROM trajectories WHERE {where} ORDER BY {_KEY}"))

    def _all(self, sql: str, values: Sequence[object] = ()) -> list[Any]:
        with self._lock:
            return self._database.execute(sql, values).fetchall()

    def _each(self, sql: str, values: Sequence[object] = ()) -> Iterator[Any]:
        """Rows, fetched a thousand at a time, because all of them may not fit into memory."""
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
    segment, offset, length, version, digest, worker, origin, sha256 = found[5:]
    return Row(_identity(found[:5]), segment, offset, length, version, digest, worker, origin, sha256.hex())
