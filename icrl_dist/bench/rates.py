"""The rates that ``icrl-dist plan`` reckons with: a little of each part of a run, timed on this machine.

Everything measured is the run's own code at the run's own sizes: a job, the inbox, steps of the
fit, episodes of the evaluation.  What is too long is timed in part and continued.
"""

from __future__ import annotations

import contextlib
import dataclasses
import itertools
import os
import platform
import queue
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch

from icrl_dist.agent import ood_score
from icrl_dist.bench.samples import Sample, in_full, made_up
from icrl_dist.collect import jobs
from icrl_dist.config.run import Run
from icrl_dist.diagnostics.estimate import PhaseRates, Rates
from icrl_dist.experts.cache import sac_of
from icrl_dist.methods.recipes import METHODS, Phase
from icrl_dist.models.dpt import PretrainedTransformer, weights_of
from icrl_dist.problems import registry, splits
from icrl_dist.results import evaluate
from icrl_dist.storage.dataset import Dataset
from icrl_dist.stream import wire
from icrl_dist.stream.credit import CreditSender
from icrl_dist.stream.link import StreamKeys
from icrl_dist.stream.zenoh_link import ZenohLink
from icrl_dist.training import batches, fit
from icrl_dist.types import Job, Trajectory
from learner.ingest import Inbox

BUDGET_S = 8.0
"""A part that takes longer is timed for so long and continued in thought."""
_ENOUGH = 64
"""Trajectories that the inbox is timed with, at least so often as to fill a second."""

Tell = Callable[[str], None]


def measure(run: Run, name: str, tell: Tell = lambda said: None, budget_s: float = BUDGET_S) -> Rates:
    """The rates of the run on this machine; ``tell`` hears what is being timed.  Some tens of seconds."""
    threads = torch.get_num_threads()
    try:
        return _measure(run, name, tell, budget_s)
    finally:
        torch.set_num_threads(threads)


def _measure(run: Run, name: str, tell: Tell, budget_s: float) -> Rates:
    method, spec = METHODS[run.method], splits.spec(run)
    model = PretrainedTransformer(spec, run.model)
    arrays = weights_of(model)
    weights = len(wire.encode_message("weights", **{key: value.tobytes() for key, value in arrays.items()}))
    device = torch.device("cuda" if run.learner.device != "cpu" and torch.cuda.is_available() else "cpu")
    seen: dict[str, tuple[float, list[Trajectory]]] = {}
    rates: list[PhaseRates] = []
    ingest = np.inf
    for phase in method.phases(run):
        asked = method.ask(run, phase)
        if phase.stage not in seen:
            tell(f"{phase.stage}: a job")
            torch.set_num_threads(1)
            seen[phase.stage] = _job(run, asked[0], model, budget_s)
            tell(f"{phase.stage}: the inbox")
            torch.set_num_threads(1)
            ingest = min(ingest, _ingest(run, asked[0], seen[phase.stage][1]))
            tell(f"{phase.stage}: steps of the fit")
            torch.set_num_threads(run.learner.threads or len(os.sched_getaffinity(0)))
            fit_step = _fit(run, phase, model.to(device), Sample({s: t for s, (_, t) in seen.items()}), budget_s)
            model.to("cpu")
        job_s, sample = seen[phase.stage]
        count = sum(job.trials * len(job.variations) for job in asked)
        # Jobs of fewer rows are not faster: a decision costs a call, whatever the number of rows.
        rates.append(
            PhaseRates(
                name=f"{phase.stage}/{phase.round}",
                jobs=len(asked),
                trajectories=count,
                env_steps=count * spec.horizon if asked[0].kind != "train_expert" else _expert_steps(asked),
                labels=count * len(sample[0].labels),
                job_s=job_s,
                message_bytes=float(np.mean([len(wire.encode_trajectory(t)) for t in sample])),
                stored_bytes=_stored(sample),
                fit_steps=phase.steps,
                fit_step_s=fit_step,
            )
        )
    tell("the evaluation")
    evaluation = 0.0 if run.method == "experts" else _evaluation(run, model, budget_s)
    tell("a start")
    return Rates(
        run=name,
        machine=f"{platform.machine()}, {torch.backends.cpu.get_cpu_capability()}, learner on {device}",
        cores=len(os.sched_getaffinity(0)),
        phases=tuple(rates),
        ingest_per_s=float(ingest),
        weights_bytes=weights,
        checkpoint_bytes=3 * weights,  # with AdamW's two moments
        start_s=_start(),
        evaluate_s=evaluation,
    )


def _expert_steps(asked: Sequence[Job]) -> int:
    return sum(sac_of(job).steps * len(job.variations) for job in asked)


class _Weights:
    """Random ones: what a decision costs does not depend on them."""

    def __init__(self, model: PretrainedTransformer) -> None:
        self._model = model

    def at(self, version: int) -> tuple[PretrainedTransformer, str]:
        return self._model, "0" * 64


def _job(run: Run, job: Job, model: PretrainedTransformer, budget_s: float) -> tuple[float, list[Trajectory]]:
    """Seconds that the job takes, and trajectories such as it delivers, all trials of some of its variations."""
    if job.kind == "train_expert":
        return _training(job, budget_s), made_up(job)
    rows, made, times = len(job.variations), [], [time.perf_counter()]
    work = jobs.do(job, _Weights(model), "plan")
    while group := list(itertools.islice(work, rows)):
        made += group
        times.append(time.perf_counter())
        if job.kind == "adapt" and times[-1] - times[0] > budget_s and len(times) > 4:
            break
    if job.kind != "adapt":  # all its episodes are stepped at once
        return times[-1] - times[0], made
    spent = np.diff(times)
    return _continued(spent, job.trials, run.context.max // model.spec.horizon), in_full(job, made)


def _continued(spent: np.ndarray, count: int, longest: int) -> float:
    """Seconds of ``count`` trials given those of the first, each a little longer than the last until contexts are full."""
    if len(spent) >= count:
        return float(spent.sum())
    slope, first = np.polyfit(np.arange(len(spent)), spent, 1) if len(spent) > 1 else (0.0, spent[0])
    later = first + max(0.0, slope) * np.minimum(np.arange(len(spent), count), max(longest, len(spent)))
    return float(spent.sum() + later.sum())


def _training(job: Job, budget_s: float) -> float:
    """Seconds of a job's SAC trainings, by episodes in which the experts learn."""
    from icrl_dist.experts.sac.batched import train
    from icrl_dist.experts.train import trained_by

    config, env = sac_of(job), registry.batch(job.variations)
    horizon = env.spec.horizon
    short = dataclasses.replace(config, random_steps=horizon, warmup=max(horizon, config.batch // len(job.variations) + 1))
    times: list[float] = []

    def progress(experts: Any, returns: np.ndarray) -> None:
        times.append(time.perf_counter())
        if len(times) > 2 and times[-1] - times[0] > budget_s:
            raise _EnoughSeen

    with contextlib.suppress(_EnoughSeen):
        train(env, short, 20 * horizon, range(env.batch), progress, by=trained_by(env.batch))
    return float(np.median(np.diff(times))) * config.steps / horizon  # the first episode is over before they learn


class _EnoughSeen(Exception):  # noqa: N818
    """Enough was timed."""


def _fit(run: Run, phase: Phase, model: PretrainedTransformer, data: Sample, budget_s: float) -> float:
    """Seconds of an optimizer step, the drawing of its batch included; 0 if the phase has no fit."""
    if not phase.steps:
        return 0.0
    pools = METHODS[run.method].learn(run, dataclasses.replace(phase, round=0), data)
    optim, times = run.optim, [0.0]

    def batch(step: int) -> batches.Batch:
        rng = np.random.default_rng(step)
        return batches.draw(rng, pools, optim.batch, optim.queries, optim.transitions, optim.windows)

    def progress(step: int, loss: float) -> None:
        times.append(time.perf_counter())
        if step >= 6 and times[-1] - times[1] > budget_s:
            raise _EnoughSeen

    with contextlib.suppress(_EnoughSeen):
        fit.fit(model, fit.Optimizer(model, optim), optim, 1e-6, 200, batch, progress)
    return float(np.mean(np.diff(times[2:])))  # contexts differ in length from step to step: the mean, not the median


def _ingest(run: Run, job: Job, sample: Sequence[Trajectory]) -> float:
    """Trajectories a second: sent on credit over a link, checked, stored with fsync, acknowledged; all in this process."""
    spec, keys, numbers = splits.spec(run), StreamKeys("plan"), itertools.count()
    acknowledged: queue.SimpleQueue[BaseException] = queue.SimpleQueue()
    few = sample[: min(len(sample), _ENOUGH)]
    with tempfile.TemporaryDirectory(dir=_disk()) as folder, contextlib.closing(Dataset(Path(folder))) as store:
        inbox = Inbox(
            store,
            spec,
            run.stream.max_message_bytes,
            lambda _: dataclasses.replace(job, trials=1 << 30),
            lambda _: few[0].weights_digest,
            lambda _: None,
            acknowledged.put,
        )
        with ZenohLink.listen("tcp/127.0.0.1:0") as link, ZenohLink.connect(link.endpoints[0], 10.0) as theirs:
            link.serve(keys.data, inbox.put)
            sender = CreditSender(theirs, keys.data, run.stream.credits, run.stream.reply_timeout_s)
            began, sent = time.perf_counter(), 0
            while time.perf_counter() - began < 1.0:
                for one in few:
                    again = dataclasses.replace(one, identity=one.identity._replace(trial=next(numbers)))
                    sender.send(wire.encode_trajectory(again))
                    sent += 1
            sender.drain(60.0)
            rate = sent / (time.perf_counter() - began)
            sender.close()
        inbox.close()
        if not acknowledged.empty():
            raise acknowledged.get()
    return rate


def _disk() -> Path:
    """Where run folders would be made, if it is there."""
    runs = Path("runs")
    return runs if runs.is_dir() else Path()


def _stored(sample: Sequence[Trajectory]) -> float:
    few = sample[:_ENOUGH]
    with tempfile.TemporaryDirectory() as folder, contextlib.closing(Dataset(Path(folder), durable=False)) as store:
        store.append(list(few))
        return sum(file.stat().st_size for file in Path(folder).iterdir()) / len(few)


def _evaluation(run: Run, model: PretrainedTransformer, budget_s: float) -> float:
    """Seconds of what ``train`` does when learning is over: surprise on the training tasks, returns on held-out ones."""
    times = [time.perf_counter()]

    def count(*_: object) -> None:
        times.append(time.perf_counter())
        if times[-1] - times[0] > budget_s:
            raise _EnoughSeen

    with contextlib.suppress(_EnoughSeen):
        ood_score.calibrate(run, model, count)
    total = _continued(np.diff(times), 2 * ood_score.EPISODES, 1 << 30)
    others = list(_others(run))
    for make, copies in [(evaluate.in_context(run, model), 1 + (len(METHODS[run.method].phases(run)) > 1)), *others]:
        times[:] = [time.perf_counter()]
        small = dataclasses.replace(run, evaluate=dataclasses.replace(run.evaluate, p=run.evaluate.p[-1:]))
        with contextlib.suppress(_EnoughSeen):
            evaluate.online(small, {"one": make}, count)
        spent = _continued(np.diff(times), run.evaluate.episodes, run.context.max // model.spec.horizon)
        total += copies * len(run.evaluate.p) * spent
    return total


def _others(run: Run) -> Iterator[tuple[evaluate.MakePolicy, int]]:
    """Who a model is held against, and how many that cost about the same."""
    if run.problem == "darkroom":
        from icrl_dist.problems.darkroom.exact_agents import RULES

        yield evaluate.random, 1
        yield evaluate.optimal(run), 1
        for rule in RULES:
            yield evaluate.exact(run, rule), 1
    else:
        yield evaluate.random_vectors, 2


def _start() -> float:
    """Seconds that a fresh process needs to import what a worker does: the learner, then the workers beside each other."""
    began = time.perf_counter()
    subprocess.run([sys.executable, "-c", "import actors.worker, learner.service, ray"], check=True)
    return 2 * (time.perf_counter() - began)
