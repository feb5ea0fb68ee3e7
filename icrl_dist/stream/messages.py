"""The messages between a worker and the learner on the work key: one dataclass a kind.

A worker sends the requests in ``REQUESTS``.  The learner replies to ``hello`` with ``Welcome``, to
``ask`` with ``Wait`` (kind ``wait``), ``LeasedJob`` (kind ``job``) or ``stop``, and to the others with
``noted``; ``stop`` and ``noted`` have no fields.  A heartbeat on the monitor plane (kind
``worker``) has the fields of ``Progress``.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Any

from annotated_types import Ge

from icrl_dist.stream.validation import Count, Stage


@dataclass(frozen=True, slots=True)
class Hello:
    """A worker's first request."""

    worker: str
    version: str
    """Version of the package that the worker runs."""
    code: str
    """Digest of the code that the worker runs."""
    plugins: dict[str, tuple[str, str, str]]
    """Distribution, version and digest of the code of every installed problem and method of another package, by
    ``problems/NAME`` or ``methods/NAME``; the worker does not know yet which of them the run has."""
    pid: Count


@dataclass(frozen=True, slots=True)
class Progress:
    """A worker's counters since its start: in every request for a job, and in every heartbeat."""

    worker: str
    episodes: Count
    """Episodes finished."""
    steps: Count
    """Steps of those episodes."""
    resent: Count
    """Times that a trajectory was sent again."""
    trajectories: Count
    """Trajectories acknowledged by the learner."""
    waited_s: Annotated[float, Ge(0)]
    """Seconds spent waiting for the learner to store trajectories."""
    job: str = ""
    """Label of the current job; empty between jobs."""
    doing: str = ""
    """A long computation of the current job, in words."""
    reached: Count = 0
    """Checkpoint that the current job has reached; see ``Scheduler.reached``."""
    policy_version: Annotated[int, Ge(-1)] = -1
    """Weights version of the current job; -1 for none."""
    pid: Count = 0
    time: float = 0.0
    """Unix seconds."""
    memory_mb: Annotated[float, Ge(0)] = 0.0
    """Resident memory now."""
    peak_mb: Annotated[float, Ge(0)] = 0.0
    """Peak resident memory."""


@dataclass(frozen=True, slots=True)
class Failed:
    """A job raised an error."""

    worker: str
    job: tuple[Stage, Count, Count, Count]
    """``Job.name``."""
    record: dict[str, Any]
    """The crash record: ``telemetry.crash_reports.raised``."""
    file: str
    """Name of the file in ``crashes/`` that the worker has written; empty if it could not."""


@dataclass(frozen=True, slots=True)
class Note:
    """A line of text for the run's event log."""

    worker: str
    text: str


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
