"""Every kind of job: its payload, and the function that does it."""

from __future__ import annotations

import dataclasses
import typing
from collections.abc import Iterator
from typing import Any

from icrl_dist.collect.adapt import LabelledRollouts, Look, Rollouts, rollouts
from icrl_dist.collect.behavior import BehaviorContexts, behavior_contexts
from icrl_dist.collect.robust import robust_labels, train_robust
from icrl_dist.experts.adversarial.payloads import RobustlyLabelledHistories, RobustPolicies
from icrl_dist.experts.payloads import ExpertHistories
from icrl_dist.experts.train import train_expert
from icrl_dist.interfaces import JobKind, Method, Problem, Progress, WeightSource, no_progress
from icrl_dist.stream import schema
from icrl_dist.stream.excerpts import nearest
from icrl_dist.types import Job, Payload, Trajectory

_WITHOUT_MODEL: dict[str, JobKind] = {
    BehaviorContexts.kind: JobKind(BehaviorContexts, behavior_contexts),
    ExpertHistories.kind: JobKind(ExpertHistories, train_expert),
    RobustPolicies.kind: JobKind(RobustPolicies, train_robust),
    RobustlyLabelledHistories.kind: JobKind(RobustlyLabelledHistories, robust_labels),
}
_WITH_MODEL: dict[str, type[Payload]] = {kind.kind: kind for kind in (Rollouts, LabelledRollouts)}


def read_payload(kind: str, problem: Problem, data: Any) -> Payload:
    """The payload of a job of this kind from plain data, decoded strictly.

    Raises ValueError for an unknown kind, an unknown or missing field, a wrong type or a value out of range.
    """
    found = _payloads(problem)
    if kind not in found:
        raise ValueError(f"job kind {kind!r}{nearest(kind, list(found))}: this worker has {', '.join(found)}")
    payload = schema.read(found[kind], data, "payload")
    if typing.get_type_hints(found[kind]).get("labelling") is Any:
        labelling: Any = schema.read(problem.Labelling, payload.labelling, "payload.labelling")  # type: ignore[attr-defined]
        payload = dataclasses.replace(payload, labelling=labelling)  # type: ignore[call-arg]
    return payload


def do(
    job: Job,
    problem: Problem,
    method: Method,
    weights: WeightSource,
    worker: str,
    progress: Progress = no_progress,
    look: Look | None = None,
) -> Iterator[Trajectory]:
    """Do the job; yields each trajectory when its episode ends.

    ``look`` is called with the in-context policy after every decision and must not change it.  Raises
    ValueError for a job of an unknown kind, or of one that needs a part which the problem lacks.
    """
    for part in job.payload.needs:
        if getattr(problem, part) is None:
            raise ValueError(f"job kind {job.kind!r}: {problem.name} lacks Problem.{part}; use another kind, or define it")
    if isinstance(job.payload, Rollouts):
        return rollouts(job, problem, method, weights, worker, look)
    kinds = {**_WITHOUT_MODEL, **problem.job_kinds}
    if job.kind not in kinds:
        known = [*_WITH_MODEL, *kinds]
        raise ValueError(f"job kind {job.kind!r}{nearest(job.kind, known)}: this worker has {', '.join(known)}")
    return kinds[job.kind].do(job, problem, worker, progress)


def _payloads(problem: Problem) -> dict[str, type[Payload]]:
    kinds = {**_WITHOUT_MODEL, **problem.job_kinds}
    return {**_WITH_MODEL, **{name: kind.payload for name, kind in kinds.items()}}
