"""Measures the rates for ``icrl-dist plan``: times a sample of each part of a run on this machine.

The code and the sizes are those of the run: a job, the ingest, steps of the fit, episodes of the
evaluation.  Parts that take too long are timed partly and extrapolated.
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
from icrl_dist.bench.samples import Sample, all_trials, random_trajectories
from icrl_dist.collect import jobs
from icrl_dist.config.run import Run
from icrl_dist.diagnostics.estimate import PhaseRates, Rates
from icrl_dist.experts.cache import sac_of
from icrl_dist.methods.recipes import METHODS, Phase
from icrl_dist.models.dpt import PretrainedTransformer
from icrl_dist.models.weights import weights_of
from icrl_dist.problems import registry, splits
from icrl_dist.results import evaluate
from icrl_dist.stream import wire
from icrl_dist.stream.credit import CreditSender
from icrl_dist.stream.zenoh_link import ZenohLink
from icrl_dist.training import batches, fit
from icrl_dist.types import Job, Trajectory
from learner.ingest import Ingest

BUDGET_S = 8.0
"""A part that takes longer is timed for this long and extrapolated."""
_SAMPLE = 64
"""Trajectories that the ingest and the store are timed with; the ingest gets them repeatedly, for one second."""

Report = Callable[[str], None]


def measure(run: Run, name: str, report: Report = lambda text: None, budget_s: float = BUDGET_S) -> Rates:
    """Measure the rates of the run on this machine, in some tens of seconds; ``report`` is called with each part."""
    threads = torch.get_num_threads()
    try:
        return _measure(run, name, report, budget_s)
    finally:
        torch.set_num_threads(threads)


def _measure(run: Run, name: str, report: Report, budget_s: float) -> Rates:
    method, spec = METHODS[run.method], splits.spec(run)
    model = PretrainedTransformer(spec, run.model)
    arrays = weights_of(model)
    weights = len(wire.encode_message("weights", **{key: value.tobytes() for key, value in arrays.items()}))
    device = torch.device("cuda" if run.learner.device != "cpu" and torch.cuda.is_available() else "cpu")
    samples: dict[str, tuple[float, list[Trajectory]]] = {}
    rates: list[PhaseRates] = []
    ingest = np.inf
    for phase in method.phases(run):
        jobs_of_phase = method.ask(run, phase)
        if phase.stage not in samples:
            report(f"{phase.stage}: a job")
            torch.set_num_threads(1)
            samples[phase.stage] = _job(run, jobs_of_phase[0], model, budget_s)
            report(f"{phase.stage}: the ingest")
            torch.set_num_threads(1)
            ingest = min(ingest, _ingest(run, jobs_of_phase[0], samples[phase.stage][1]))
            report(f"{phase.stage}: steps of the fit")
            torch.set_num_threads(run.learner.threads or len(os.sched_getaffinity(0)))
            fit_step = _fit(run, phase, model.to(device), Sample({s: t for s, (_, t) in samples.items()}), budget_s)
            model.to("cpu")
        job_s, sample = samples[phase.stage]
        count = sum(job.trials * len(job.variations) for job in jobs_of_phase)
        # The time of the first job is used for all: fewer rows are not faster, because a decision is one call.
        rates.append(
            PhaseRates(
                name=f"{phase.stage}/{phase.round}",
                jobs=len(jobs_of_phase),
                trajectories=count,
                env_steps=count * spec.horizon if jobs_of_phase[0].kind != "train_expert" else _expert_steps(jobs_of_phase),
                labels=count * len(sample[0].labels),
                job_s=job_s,
                message_bytes=float(np.mean([len(wire.encode_trajectory(t)) for t in sample])),
                stored_bytes=_stored(sample),
                fit_steps=phase.steps,
                fit_step_s=fit_step,
            )
        )
    report("the evaluation")
    evaluation = 0.0 if run.method == "experts" else _evaluation(run, model, budget_s)
    report("a start")
    return Rates(
        run=name,
        machine=f"{platform.machine()}, {torch.backends.cpu.get_cpu_capability()}, learner on {device}",
        cores=len(os.sched_getaffinity(0)),
        phases=tuple(rates),
        ingest_per_s=float(ingest),
        weights_bytes=weights,
        checkpoint_bytes=3 * weights,  # weights and AdamW's two moments
        start_s=_start(),
        evaluate_s=evaluation,
    )


def _expert_steps(expert_jobs: Sequence[Job]) -> int:
    return sum(sac_of(job).steps * len(job.variations) for job in expert_jobs)


class _RandomWeights:
    """A policy source with an untrained model: the cost of a decision does not depend on the weights."""

    def __init__(self, model: PretrainedTransformer) -> None:
        self._model = model

    def at(self, version: int) -> tuple[PretrainedTransformer, str]:
        return self._model, "0" * 64


def _job(run: Run, job: Job, model: PretrainedTransformer, budget_s: float) -> tuple[float, list[Trajectory]]:
    """Seconds of the job, and trajectories like its own: all trials of some of its variations."""
    if job.kind == "train_expert":
        return _training(job, budget_s), random_trajectories(job)
    rows, trajectories, times = len(job.variations), [], [time.perf_counter()]
    work = jobs.do(job, _RandomWeights(model), "plan")
    while group := list(itertools.islice(work, rows)):
        trajectories += group
        times.append(time.perf_counter())
        if job.kind == "adapt" and times[-1] - times[0] > budget_s and len(times) > 4:
            break
    if job.kind != "adapt":  # its episodes run together, so the time is that of the whole job
        return times[-1] - times[0], trajectories
    spent = np.diff(times)
    return _extrapolated(spent, job.trials, run.context.max // model.spec.horizon), all_trials(job, trajectories)


def _extrapolated(spent: np.ndarray, count: int, longest: int) -> float:
    """Seconds of ``count`` trials from those of the first ones; times grow linearly until contexts are full."""
    if len(spent) >= count:
        return float(spent.sum())
    slope, first = np.polyfit(np.arange(len(spent)), spent, 1) if len(spent) > 1 else (0.0, spent[0])
    later = first + max(0.0, slope) * np.minimum(np.arange(len(spent), count), max(longest, len(spent)))
    return float(spent.sum() + later.sum())


def _training(job: Job, budget_s: float) -> float:
    """Seconds of a job's SAC training, extrapolated from episodes with updates."""
    from icrl_dist.experts.sac.batched import train
    from icrl_dist.experts.train import trained_by

    config, env = sac_of(job), registry.batch(job.variations)
    horizon = env.spec.horizon
    short = dataclasses.replace(config, random_steps=horizon, warmup=max(horizon, config.batch // len(job.variations) + 1))
    times: list[float] = []

    def progress(experts: Any, returns: np.ndarray) -> None:
        times.append(time.perf_counter())
        if len(times) > 2 and times[-1] - times[0] > budget_s:
            raise _BudgetSpent

    with contextlib.suppress(_BudgetSpent):
        train(env, short, 20 * horizon, range(env.batch), progress, backend=trained_by(env.batch))
    return float(np.median(np.diff(times))) * config.steps / horizon  # without the first episode, which has no updates


class _BudgetSpent(Exception):  # noqa: N818
    """The time budget of this measurement is spent."""


def _fit(run: Run, phase: Phase, model: PretrainedTransformer, data: Sample, budget_s: float) -> float:
    """Seconds of an optimizer step with the drawing of its batch; 0 if the phase has no fit."""
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
            raise _BudgetSpent

    with contextlib.suppress(_BudgetSpent):
        fit.fit(model, fit.Optimizer(model, optim), optim, 1e-6, 200, batch, progress)
    return float(np.mean(np.diff(times[2:])))  # the mean, not the median: contexts differ in length between steps


def _ingest(run: Run, job: Job, sample: Sequence[Trajectory]) -> float:
    """Trajectories per second sent with credits over a link, checked, stored with fsync and acknowledged, in this process."""
    spec, keys, numbers = splits.spec(run), Keys("plan"), itertools.count()
    failures: queue.SimpleQueue[BaseException] = queue.SimpleQueue()
    few = sample[:_SAMPLE]
    with tempfile.TemporaryDirectory(dir=_run_disk()) as folder, contextlib.closing(Store(Path(folder))) as store:
        ingest = Ingest(
            store,
            spec,
            run.stream.max_message_bytes,
            lambda _: dataclasses.replace(job, trials=1 << 30),
            lambda _: few[0].weights_digest,
            lambda _: None,
            failures.put,
        )
        with ZenohLink.listen("tcp/127.0.0.1:0") as link, ZenohLink.connect(link.endpoints[0], 10.0) as theirs:
            link.serve(keys.data, ingest.put)
            sender = CreditSender(theirs, keys.data, run.stream.credits, run.stream.reply_timeout_s)
            began, sent = time.perf_counter(), 0
            while time.perf_counter() - began < 1.0:
                for trajectory in few:
                    identity = trajectory.identity._replace(trial=next(numbers))
                    sender.send(wire.encode_trajectory(dataclasses.replace(trajectory, identity=identity)))
                    sent += 1
            sender.drain(60.0)
            rate = sent / (time.perf_counter() - began)
            sender.close()
        ingest.close()
        if not failures.empty():
            raise failures.get()
    return rate


def _run_disk() -> Path:
    """The folder of runs if it exists, else the current folder."""
    runs = Path("runs")
    return runs if runs.is_dir() else Path()


def _stored(sample: Sequence[Trajectory]) -> float:
    few = sample[:_SAMPLE]
    with tempfile.TemporaryDirectory() as folder, contextlib.closing(Store(Path(folder), durable=False)) as store:
        store.append(list(few))
        return sum(file.stat().st_size for file in Path(folder).iterdir()) / len(few)


def _evaluation(run: Run, model: PretrainedTransformer, budget_s: float) -> float:
    """Seconds of the end of ``train``: calibration of the OOD score on training tasks, returns on held-out tasks."""
    times = [time.perf_counter()]

    def count(*_: object) -> None:
        times.append(time.perf_counter())
        if times[-1] - times[0] > budget_s:
            raise _BudgetSpent

    with contextlib.suppress(_BudgetSpent):
        ood_score.calibrate(run, model, count)
    total = _extrapolated(np.diff(times), 2 * ood_score.EPISODES, 1 << 30)
    others = list(_baselines(run))
    for make, copies in [(evaluate.in_context(run, model), 1 + (len(METHODS[run.method].phases(run)) > 1)), *others]:
        times[:] = [time.perf_counter()]
        small = dataclasses.replace(run, evaluate=dataclasses.replace(run.evaluate, p=run.evaluate.p[-1:]))
        with contextlib.suppress(_BudgetSpent):
            evaluate.online(small, {"one": make}, count)
        spent = _extrapolated(np.diff(times), run.evaluate.episodes, run.context.max // model.spec.horizon)
        total += copies * len(run.evaluate.p) * spent
    return total


def _baselines(run: Run) -> Iterator[tuple[evaluate.MakePolicy, int]]:
    """The baselines in the evaluation's table, and how many of them have about this cost."""
    if run.problem == "darkroom":
        from icrl_dist.problems.darkroom.exact_agents import RULES

        yield evaluate.random, 1
        yield evaluate.optimal(run), 1
        for rule in RULES:
            yield evaluate.exact(run, rule), 1
    else:
        yield evaluate.random_vectors, 2


def _start() -> float:
    """Seconds for the learner and then the workers (in parallel) to start: twice the imports in a new process."""
    began = time.perf_counter()
    subprocess.run([sys.executable, "-c", "import actors.worker, learner.service, ray"], check=True)
    return 2 * (time.perf_counter() - began)
