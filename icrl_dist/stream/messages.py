"""The messages between a worker and the learner on the work key: one dataclass a kind, every field bounded.

A worker sends the requests in ``REQUESTS``.  The learner replies to ``hello`` with ``Welcome``, to
``ask`` with ``Wait`` (kind ``wait``), ``LeasedJob`` (kind ``job``) or ``stop``, and to the others with
``noted``; ``stop`` and ``noted`` have no fields.  A heartbeat on the monitor plane (kind
``worker``) has the fields of ``Progress``.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import Annotated, Literal

from annotated_types import Ge, Interval, MaxLen, Predicate

from icrl_dist.stream.schema import Remedy
from icrl_dist.stream.validation import Count, Stage

LINE, TRACEBACK = 1_000, 20_000
"""Characters of a line of text, and of a traceback, in a worker's message; a worker cuts its text before it sends it."""


def is_name(text: str) -> bool:
    """Whether a text may be the name of a worker or of its file: it is part of keys, of file names and of every view."""
    return re.fullmatch(r"[A-Za-z0-9][A-Za-z0-9._-]{0,79}", text) is not None


WorkerName = Annotated[str, Predicate(is_name), Remedy("a worker's name has at most 80 letters, digits and . _ -")]
_FileName = Annotated[str, Predicate(lambda text: not text or is_name(text)), Remedy("name a file of the folder crashes")]
_Word = Annotated[str, MaxLen(200)]
_Line = Annotated[str, MaxLen(LINE)]
_Counter = Annotated[int, Interval(ge=0, le=2**53)]
_Amount = Annotated[float, Interval(ge=0, le=1e12)]


@dataclass(frozen=True, slots=True)
class Hello:
    """A worker's first request."""

    worker: WorkerName
    version: _Word
    """Version of the package that the worker runs."""
    code: _Word
    """Digest of the code that the worker runs."""
    plugins: dict[str, tuple[_Word, _Word, _Word]]
    """Distribution, version and digest of the code of every installed problem and method of another package, by
    ``problems/NAME`` or ``methods/NAME``; the worker does not know yet which of them the run has."""
    pid: Count


@dataclass(frozen=True, slots=True)
class Progress:
    """A worker's counters since its start: in every request for a job, and in every heartbeat."""

    worker: WorkerName
    episodes: _Counter
    """Episodes finished."""
    steps: _Counter
    """Steps of those episodes."""
    resent: _Counter
    """Times that a trajectory was sent again."""
    trajectories: _Counter
    """Trajectories acknowledged by the learner."""
    waited_s: _Amount
    """Seconds spent waiting for the learner to store trajectories."""
    job: _Word = ""
    """Label of the current job; empty between jobs."""
    doing: _Line = ""
    """A long computation of the current job, in words."""
    reached: _Counter = 0
    """Checkpoint that the current job has reached; see ``Scheduler.reached``."""
    policy_version: Annotated[int, Ge(-1)] = -1
    """Weights version of the current job; -1 for none."""
    pid: Count = 0
    time: float = 0.0
    """Unix seconds."""
    memory_mb: _Amount = 0.0
    """Resident memory now."""
    peak_mb: _Amount = 0.0
    """Peak resident memory."""


@dataclass(frozen=True, slots=True)
class CrashRecord:
    """What ``telemetry.crash_reports.raised`` records of an error; None: not known."""

    what: Literal["raised"]
    worker: WorkerName
    job: _Word
    exception: _Line
    time: float | None = None
    """Unix seconds."""
    identity: _Word | None = None
    spawn_key: Annotated[tuple[int, ...], MaxLen(8)] | None = None
    seed: int | None = None
    policy_version: int | None = None
    variations: _Counter | None = None
    memory_mb: _Amount | None = None
    peak_mb: _Amount | None = None
    traceback: Annotated[str, MaxLen(TRACEBACK)] | None = None


@dataclass(frozen=True, slots=True)
class Failed:
    """A job raised an error."""

    worker: WorkerName
    job: tuple[Stage, Count, Count, Count]
    """``Job.name``."""
    record: CrashRecord
    file: _FileName
    """Name of the file in ``crashes/`` that the worker has written; empty if it could not."""
    ends_run: _Line = ""
    """Why the run cannot go on before a person decides, with the remedy; empty: the job is repeated."""


@dataclass(frozen=True, slots=True)
class Note:
    """A line of text for the run's event log."""

    worker: WorkerName
    text: _Line


@dataclass(frozen=True, slots=True)
class Welcome:
    """Reply to ``Hello``."""

    run: str
    """The run file's text."""


@dataclass(frozen=True, slots=True)
class Wait:
    """Reply to a request for a job: there is none now."""

    seconds: Annotated[float, Ge(0)]
    """Time until the next request."""


@dataclass(frozen=True, slots=True)
class LeasedJob:
    """Reply to a request for a job."""

    name: tuple[Stage, Count, Count, Count]
    """``Job.name``, by which a worker that cannot decode the job reports its failure."""
    job: bytes
    """For ``wire.decode_job``."""
    deadline_s: Annotated[float, Ge(0)]
    """Seconds that each trajectory may take."""


REQUESTS: dict[str, type] = {"hello": Hello, "ask": Progress, "failed": Failed, "note": Note}
"""The class of a request, by its kind."""
