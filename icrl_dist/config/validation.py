"""Check the settings of a run: first the range of each field, then whether fields are compatible."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING, Any

from icrl_dist.config import plugins
from icrl_dist.config.ranges import remedy
from icrl_dist.config.sections import PretrainConfig
from icrl_dist.config.toml import ConfigError
from icrl_dist.stream import endpoints, schema

if TYPE_CHECKING:
    from icrl_dist.config.run import Run

Objection = tuple[str, object, str]
"""The key, its value, and the remedy."""


def validate(run: Run, source: str) -> None:
    """Raises ConfigError for values that are out of range or incompatible."""
    try:
        schema.check(run)
        owner = plugins.find("problems", run.problem)
        problem = owner(run.problem, run.section(owner.section))
        method = plugins.find("methods", run.method)()
    except (schema.Invalid, ConfigError) as error:
        raise ConfigError(f"{source}: {error}") from None
    for objections in (problem.objections(run), _objections(run, problem), method.objections(run)):
        for where, value, advice in objections:
            raise ConfigError(f"{source}: {where} = {value!r}: {advice}")


def _objections(run: Run, problem: Any) -> Iterator[Objection]:
    """Incompatible values that no problem or method allows."""
    train = problem.train_count
    if not train:
        yield "problem", run.problem, "its split has no training tasks: change its section"
    if plugins.find("methods", run.method).trains and not problem.evaluated_count:
        yield "problem", run.problem, "it has no tasks to evaluate on: change its section"
    if not run.adversary.variations:
        yield "adversary.count", 0, "use at least 1, or adversary.null = true, which trains on the tasks without disturbance"
    if run.adversary.p_min > run.adversary.p_max:
        yield "adversary.p_min", run.adversary.p_min, f"use 0 to adversary.p_max, which is {run.adversary.p_max:g}"
    icaa, horizon = run.icaa, problem.horizon
    if run.pretrain.contexts < train:
        yield "pretrain.contexts", run.pretrain.contexts, remedy(train, None, "at least one per training task")
    if icaa.context_trials >= icaa.trials:
        yield "icaa.context_trials", icaa.context_trials, remedy(0, icaa.trials - 1, "it must be below icaa.trials")
    if run.model.window > horizon:
        yield "model.window", run.model.window, remedy(1, horizon, f"at most the horizon, {horizon} steps")
    low, high = (1, None) if run.model.window > 1 else (0, 0)
    for where, windows in (("pretrain.windows", run.pretrain.windows), ("optim.windows", run.optim.windows)):
        if (windows > 0) != (run.model.window > 1):
            yield where, windows, remedy(low, high, "above 0 exactly if model.window is above 1")
    if run.model.width % run.model.heads:
        yield "model.heads", run.model.heads, "must divide model.width"
    if run.context.max < horizon:
        yield "context.max", run.context.max, remedy(horizon, None, f"at least one episode ({horizon} steps)")
    if run.dagger.rounds and problem.labeller is None:
        yield "dagger.rounds", run.dagger.rounds, "only a problem with exact answers can label new histories"
    yield from _context_objections(run, problem)
    yield from _address_objections(run)


def _context_objections(run: Run, problem: Any) -> Iterator[Objection]:
    behaviors, named = problem.behaviors, run.pretrain.behaviors
    if behaviors is None and named != PretrainConfig().behaviors:
        yield "pretrain.behaviors", named, f"{run.problem} has no behavior policies; leave it out"
    if behaviors is not None and not set(named) <= set(behaviors.names):
        yield "pretrain.behaviors", named, f"choose from {', '.join(behaviors.names)}"
    payload = problem.contexts(run).payload
    for part in payload.needs:
        if getattr(problem, part) is None:
            remedy = (
                f"its contexts (jobs {payload.kind}) need Problem.{part}, which is None; define it in {type(problem).__name__}"
            )
            yield "problem", run.problem, remedy


def _address_objections(run: Run) -> Iterator[Objection]:
    host, _, port = run.learner.prometheus.rpartition(":")
    valid = bool(host and port.isascii() and port.isdigit() and 0 < int(port) < 65536)
    if run.learner.prometheus and not valid:
        yield "learner.prometheus", run.learner.prometheus, "use HOST:PORT, such as 127.0.0.1:9464, or nothing"
    for name, endpoint, advice in endpoints.objections(run.stream.endpoint, run.stream.connect, run.stream.certificates):
        yield f"stream.{name}", endpoint, advice
