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
import tempfile
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch

from icrl_dist.agent import ood_score
from icrl_dist.agent.trained_model import TrainedModel
from icrl_dist.bench.samples import RandomWeights, Sample, all_trials, random_trajectories
from icrl_dist.collect import kinds
from icrl_dist.collect.adapt import Rollouts
from icrl_dist.config.run import Run
from icrl_dist.config.sac import SACConfig
from icrl_dist.diagnostics.estimate import PhaseRates, Rates
from icrl_dist.experts.payloads import ExpertHistories
from icrl_dist.interfaces import Phase, Problem, Reference
from icrl_dist.methods import registry as methods
from icrl_dist.models.weights import weights_of
from icrl_dist.problems import registry
from icrl_dist.results import evaluate
from icrl_dist.storage.dataset import Dataset
from icrl_dist.stream import wire
from icrl_dist.stream.credit import CreditSender
from icrl_dist.stream.link import StreamKeys
from icrl_dist.stream.zenoh_link import ZenohLink
from icrl_dist.telemetry import processes
from icrl_dist.training import fit
from icrl_dist.training.kernel_fit import KernelFit
from icrl_dist.training.reproducible import best_fit
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
    method, spec = methods.of(run), registry.of(run).spec
    trained = TrainedModel(run, method, spec, method.build(spec, run))
    arrays = weights_of(trained.model)
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
            samples[phase.stage] = _job(trained, jobs_of_phase[0], budget_s)
            report(f"{phase.stage}: the ingest")
            torch.set_num_threads(1)
            ingest = min(ingest, _ingest(run, jobs_of_phase[0], samples[phase.stage][1]))
            report(f"{phase.stage}: steps of the fit")
            torch.set_num_threads(run.learner.threads or len(os.sched_getaffinity(0)))
            trained.model.to(device)
            fit_step = _fit(trained, phase, Sample({s: t for s, (_, t) in samples.items()}), budget_s)
            trained.model.to("cpu")
        job_s, sample = samples[phase.stage]
        count = sum(job.trials * len(job.variations) for job in jobs_of_phase)
        # The time of the first job is used for all: fewer rows are not faster, because a decision is one call.
        rates.append(
            PhaseRates(
                name=f"{phase.stage}/{phase.round}",
                jobs=len(jobs_of_phase),
                trajectories=count,
                env_steps=sum(job.payload.env_steps(job.trials, spec.horizon) * len(job.variations) for job in jobs_of_phase),
                labels=count * len(sample[0].labels),
                job_s=job_s,
                message_bytes=float(np.mean([len(wire.encode_trajectory(t)) for t in sample])),
                stored_bytes=_stored(sample),
                fit_steps=phase.steps,
                fit_step_s=fit_step,
            )
        )
    report("the evaluation")
    evaluation = _evaluation(trained, budget_s) if method.trains else 0.0
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


def _job(trained: TrainedModel, job: Job, budget_s: float) -> tuple[float, list[Trajectory]]:
    """Seconds of the job, and trajectories like its own: all trials of some of its variations."""
    if isinstance(job.payload, ExpertHistories):
        problem = registry.of(trained.run)
        return _training(job, problem, job.payload.sac, budget_s), random_trajectories(job, problem)
    run, by_model = trained.run, isinstance(job.payload, Rollouts)
    rows, trajectories, times = len(job.variations), [], [time.perf_counter()]
    work = kinds.do(job, registry.of(run), trained.method, RandomWeights(trained.model), "plan")
    while group := list(itertools.islice(work, rows)):
        trajectories += group
        times.append(time.perf_counter())
        if by_model and times[-1] - times[0] > budget_s and len(times) > 4:
            break
    if not by_model:  # its episodes run together, so the time is that of the whole job
        return times[-1] - times[0], trajectories
    spent = np.diff(times)
    return _extrapolated(spent, job.trials, run.context.max // trained.spec.horizon), all_trials(job, trajectories)


def _extrapolated(spent: np.ndarray, count: int, longest: int) -> float:
    """Seconds of ``count`` trials from those of the first ones; times grow linearly until contexts are full."""
    if len(spent) >= count:
        return float(spent.sum())
    slope, first = np.polyfit(np.arange(len(spent)), spent, 1) if len(spent) > 1 else (0.0, spent[0])
    later = first + max(0.0, slope) * np.minimum(np.arange(len(spent), count), max(longest, len(spent)))
    return float(spent.sum() + later.sum())


def _training(job: Job, problem: Problem, config: SACConfig, budget_s: float) -> float:
    """Seconds of a job's SAC training, extrapolated from episodes with updates."""
    from icrl_dist.experts.sac.batched import train
    from icrl_dist.experts.train import sac_backend

    env = problem.batch(job.variations)
    horizon = env.spec.horizon
    short = dataclasses.replace(config, random_steps=horizon, warmup=max(horizon, config.batch // len(job.variations) + 1))
    times: list[float] = []

    def progress(experts: Any, returns: np.ndarray) -> None:
        times.append(time.perf_counter())
        if len(times) > 2 and times[-1] - times[0] > budget_s:
            raise _BudgetSpent

    with contextlib.suppress(_BudgetSpent):
        train(env, short, 20 * horizon, range(env.batch), progress, backend=sac_backend(env.batch))
    return float(np.median(np.diff(times))) * config.steps / horizon  # without the first episode, which has no updates


class _BudgetSpent(Exception):  # noqa: N818
    """The time budget of this measurement is spent."""


def _fit(trained: TrainedModel, phase: Phase, data: Sample, budget_s: float) -> float:
    """Seconds of an optimizer step with the drawing of its batch; 0 if the phase has no fit."""
    if not phase.steps:
        return 0.0
    run, model = trained.run, trained.model
    method = methods.of(run)  # a new one, because a method caches what it computed from the data of its run
    draw = method.data(run, dataclasses.replace(phase, round=0), data)
    optim, times = run.optim, [0.0]

    def batch_of(step: int) -> Any:
        return draw(np.random.default_rng(step))

    def progress(step: int, loss: float) -> None:
        times.append(time.perf_counter())
        if step >= 6 and times[-1] - times[1] > budget_s:
            raise _BudgetSpent

    with contextlib.suppress(_BudgetSpent):
        if run.learner.reproducible != "this-machine" and best_fit(run) == "any-machine":
            kernel = KernelFit(trained.spec, run.model, optim, weights_of(model), torch.get_num_threads())
            fit.take_steps(lambda step, rate: kernel.step(batch_of(step), rate), optim, 1e-6, 200, progress)
        else:
            loss_of = lambda step: method.loss(model, batch_of(step))  # noqa: E731
            fit.fit(model, fit.Optimizer(model, optim), optim, 1e-6, 200, loss_of, progress)
    return float(np.mean(np.diff(times[2:])))  # the mean, not the median: contexts differ in length between steps


def _ingest(run: Run, job: Job, sample: Sequence[Trajectory]) -> float:
    """Trajectories per second sent with credits over a link, checked, stored with fsync and acknowledged, in this process."""
    spec, keys, numbers = registry.of(run).spec, StreamKeys("plan"), itertools.count()
    failures: queue.SimpleQueue[BaseException] = queue.SimpleQueue()
    few = sample[:_SAMPLE]
    with tempfile.TemporaryDirectory(dir=_run_disk()) as folder, contextlib.closing(Dataset(Path(folder))) as store:
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
    with tempfile.TemporaryDirectory() as folder, contextlib.closing(Dataset(Path(folder), durable=False)) as store:
        store.append(list(few))
        return sum(file.stat().st_size for file in Path(folder).iterdir()) / len(few)


def _evaluation(trained: TrainedModel, budget_s: float) -> float:
    """Seconds of the end of ``train``: calibration of the OOD score on training tasks, returns on held-out tasks."""
    run, times = trained.run, [time.perf_counter()]

    def count(*_: object) -> None:
        times.append(time.perf_counter())
        if times[-1] - times[0] > budget_s:
            raise _BudgetSpent

    total = 0.0
    if trained.method.shows_states:
        with contextlib.suppress(_BudgetSpent):
            ood_score.calibrate(trained, count)
        total = _extrapolated(np.diff(times), 2 * ood_score.EPISODES, 1 << 30)
    models = 1 + (len(trained.method.phases(run)) > 1)
    for make, copies in [(Reference(evaluate.in_context(trained, trained.run.context)), models), *_references(run)]:
        times[:] = [time.perf_counter()]
        small = dataclasses.replace(run, evaluate=dataclasses.replace(run.evaluate, p=run.evaluate.p[-1:]))
        with contextlib.suppress(_BudgetSpent):
            evaluate.online(small, {evaluate.Agent("one"): make}, count)
        spent = _extrapolated(np.diff(times), run.evaluate.episodes, run.context.max // trained.spec.horizon)
        total += copies * len(run.evaluate.p) * spent
    return total


def _references(run: Run) -> list[tuple[Reference, int]]:
    """The references in the evaluation's table, and how many of them have about this cost."""
    problem = registry.of(run)
    references = [(reference, 1) for reference in problem.references(run).values()]
    if references and problem.missing_reference(run, run.problem):
        # The missing one may exist after the training; it costs about as much as the first, a random policy.
        references[0] = references[0][0], 2
    return references


def _start() -> float:
    """Seconds for the learner and then the workers (in parallel) to start: twice the imports in a new process."""
    began = time.perf_counter()
    command = processes.python("-c", "import actors.worker, learner.service, ray")
    subprocess.run(command, check=True, env=processes.environment())
    return 2 * (time.perf_counter() - began)
