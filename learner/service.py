"""The learner: for each phase, opens its jobs, stores the trajectories, fits the model and publishes its weights."""

from __future__ import annotations

import contextlib
import os
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch

from icrl_dist.config.run import Run
from icrl_dist.interfaces import Phase
from icrl_dist.methods import registry as methods
from icrl_dist.problems import registry
from icrl_dist.results import training_rows
from icrl_dist.storage import checkpoint, files, layout
from icrl_dist.storage.dataset import Damaged, Dataset
from icrl_dist.storage.fork import Lineage
from icrl_dist.stream.link import Link, StreamKeys
from icrl_dist.telemetry import provenance
from icrl_dist.telemetry.metrics import Metrics
from icrl_dist.types import Identity, Job, Trajectory, Weights
from learner import checkpoints, recovery
from learner.broadcast import Broadcast
from learner.fitting import Fitting, RunFailed, device_of
from learner.ingest import Ingest
from learner.past import PastServer
from learner.phases import PhasePlan
from learner.reporter import Reporter
from learner.scheduler import LeaseScheduler
from learner.worker_api import WorkerAPI

__all__ = ["Interrupted", "RunFailed", "Service"]

Report = Callable[[dict[str, Any]], None]


class Interrupted(Exception):  # noqa: N818
    """The run ended because of ``Service.stop``; a checkpoint is written."""


class Service:
    """The learner of one run.  ``report`` is called with every event as a dict, for a terminal."""

    def __init__(self, run: Run, folder: Path, link: Link, report: Report) -> None:
        """Opens the run folder and continues from its checkpoints and its dataset.

        Raises StoreError if another learner uses the folder, or if its files cannot be used.
        """
        self._run, self._folder, self._link, self._report = run, folder, link, report
        layout.refuse_odd_files(folder)
        with contextlib.ExitStack() as closing:
            closing.enter_context(files.hold(folder))
            self._open(closing)
            self._closing = closing.pop_all()

    def _open(self, closing: contextlib.ExitStack) -> None:
        """Create the parts of the learner; ``closing`` gets the function that closes each."""
        run, folder, link, report = self._run, self._folder, self._link, self._report
        self._keys = StreamKeys(folder.name)
        self._spec = registry.of(run).spec
        lineage = Lineage.of(folder, run)
        self._threads = run.learner.threads or len(os.sched_getaffinity(0))
        self._device = device_of(run.learner)
        self._method = methods.of(run)
        notes = list[str]()
        self._plan = PhasePlan(run, lineage, self._method)
        found = recovery.intact(folder, run, lineage, self._plan.phases[-1].next_version, notes.append)
        self._data = recovery.DataCheck(folder, found)
        self._fitting = Fitting(run, folder, self._method, self._spec, self._device, self._threads, found, notes.append)
        newest = self._fitting.load()
        self._metrics = Metrics(folder, prometheus=run.learner.prometheus)
        closing.callback(self._metrics.close)
        self._reporter = Reporter(run, folder, link, self._keys, self._metrics, report, lambda: self.version)
        closing.callback(self._reporter.flush)
        self._lock = threading.Lock()
        self._scheduler = LeaseScheduler(run.stream.lease_s)
        self._stop = threading.Event()
        self._changed = threading.Event()
        self._error: BaseException | None = None
        self._lag = 0
        self._repairs = 0
        for text in notes:
            self._note(text)
        self._fitting.note = self._note
        self.store = self._plan.store = Dataset(folder / "dataset", check=self._plan.refusal)
        closing.callback(self.store.close)
        self._report_repairs()
        self._data.weights(self.store)
        self._plan.quarantine(dict(found[max(found)].get("quarantined", {})) if found else {})
        self._open_phases: set[Phase] = set()
        self._broadcast = Broadcast(link, self._keys, self._load_weights)
        self.ingest = Ingest(
            self.store,
            self._spec,
            run.stream.max_message_bytes,
            self._pending_job,
            self._broadcast.digest_of,
            self._stored,
            self.fail,
            registry.of(run).limits,
        )
        closing.callback(self.ingest.close)
        policy_version = lambda job: self._plan.policy_version(job, self.version)  # noqa: E731
        fail = lambda line: self.fail(RunFailed(line))  # noqa: E731
        report = self._reporter.event
        self.worker_api = WorkerAPI(run, folder, link, self._keys, self._scheduler, self._lock, report, fail, policy_version)
        closing.callback(self.worker_api.close)
        closing.callback(PastServer(link, self._keys, run, folder, self.store).close)
        self._serving = False
        if newest is not None:
            self._broadcast.publish(newest)
        made_by = provenance.record(run.problem, run.method, self._threads, self._fitting.device_name, run.learner.reproducible)
        self._any_machine: bool = made_by["any_machine"]
        if changed := provenance.add_session(folder, self.version, made_by):
            self._note(changed)
            self._data.excused = changed
        elif run.stream.staleness:
            self._data.excused = "rounds overlap (stream.staleness), so other versions may have collected it"

    def _note(self, text: str) -> None:
        self._reporter.event({"event": "note", "text": text})

    @property
    def version(self) -> int:
        """The newest policy version; -1 before the first."""
        return self._fitting.version

    @property
    def device(self) -> str:
        """The device of fits: ``cuda, NVIDIA H100`` or ``cpu, 2 threads``."""
        name = self._fitting.device_name
        return f"cuda, {name}" if self._device.type == "cuda" else f"cpu, {self._threads} threads"

    # Called from other threads.

    def stop(self) -> None:
        """End the run soon, with a checkpoint."""
        self._stop.set()
        self._changed.set()

    def fail(self, error: BaseException) -> None:
        """End the run with this error."""
        self._error = error
        self._changed.set()

    def _pending_job(self, identity: Identity) -> Job | None:
        """The job that this trajectory is missing from; None if it is stored or was not requested."""
        with self._lock:
            job = self._scheduler.pending_job(identity)
            if job is None:
                self._scheduler.repeated(identity, time.monotonic())
            return job

    def _stored(self, trajectory: Trajectory) -> None:
        """Record that a trajectory is stored."""
        identity = trajectory.identity
        with self._lock:
            self._scheduler.received(identity, time.monotonic())
            done = self._scheduler.done(identity.stage, identity.round)
        if identity.stage == "adapt":
            self._lag = identity.round - trajectory.policy_version
        self._reporter.stored(trajectory)
        if done:
            self._changed.set()

    def _load_weights(self, version: int) -> Weights:
        """The weights of an earlier version, from its checkpoint.  Ends the run if they are lost."""
        file = checkpoint.version_file(self._folder, version)
        try:
            return checkpoints.weights_of_file(file, version)
        except files.StoreError as error:
            self.fail(RunFailed(f"{error}: T^{version} was lost while the run was active; --resume fits it again"))
            raise
        except Exception as error:  # else workers would ask for ever
            self.fail(error)
            raise

    # Called from the thread of ``run``.

    def run(self) -> dict[str, Any]:
        """Run all phases of the method; returns digests, counts and versions for ``result.json``.

        Raises Interrupted after ``stop``, when a checkpoint is written; RunFailed or StoreError if the
        run cannot continue.
        """
        try:
            result = self._run_phases()
        except Interrupted:
            self._reporter.log("interrupted", f"interrupted with T^{self.version} and {len(self.store)} trajectories")
            raise
        except Exception as error:
            self._reporter.log("failed", f"failed: {error}")
            raise
        self._reporter.log("finished", f"finished with T^{self.version} and {len(self.store)} trajectories")
        return result

    def _run_phases(self) -> dict[str, Any]:
        self._reporter.describe(self._plan.phases, [job for phase in self._plan.phases for job in self._plan.ask(phase)])
        while (phase := self._next_phase()) is not None:
            if phase.next_version <= self.version:
                jobs = ", ".join(job.label for job in self._plan.incomplete(phase))
                self._note(f"trajectories of {jobs} are missing: collecting them again")
                self._data.collected = True
            try:
                self._collect(phase)
                if phase.next_version > self.version:
                    self._fit(phase)
            except Damaged as error:
                self._note(str(error))
                self.store.repair()
                self._report_repairs()
                self._plan.recheck()
                # The old object may have cached results from trajectories that are now replaced.
                self._method = self._plan.method = self._fitting.method = methods.of(self._run)
        self.store.seal()
        return {
            "dataset_digest": self.store.digest(),
            "weights_digest": self._broadcast.digest_of(self.version),
            "version": self.version,
            "trajectories": len(self.store),
            "drops": dict(self.ingest.drops),
            "resent": self.worker_api.known.resent,
            "repaired": self._repairs,
            "quarantined": [{"variation": name, "cause": cause} for name, cause in self._plan.quarantined.items()],
            "staleness": self._run.stream.staleness,
            "lag": {str(lag): count for lag, count in self.store.index.lags().items()},
            "threads": self._threads,
            "instruction_set": torch.backends.cpu.get_cpu_capability(),
            "any_machine": self._any_machine,
        }

    def _next_phase(self) -> Phase | None:
        """The next phase to collect or fit; compares the data of fitted versions with their checkpoints once it is complete."""
        phase = self._plan.next(self.version)
        if self._data.manifests and (phase is None or phase.next_version > max(self._data.manifests)):
            self._data.data(self.store, self._plan.quarantined, self._note)
        return phase

    def close(self) -> None:
        """Stop storing trajectories and close all files."""
        self._closing.close()

    def _open_phase(self, phase: Phase) -> None:
        """Open the jobs of a phase for leasing, and those of later phases that may overlap with it."""
        for one in (phase, *self._plan.ahead(phase, self.version)):
            if one not in self._open_phases:
                jobs = self._plan.ask(one)
                with self._lock:
                    self._scheduler.open(jobs, self._plan.not_needed)
                self._open_phases.add(one)

    def _collect(self, phase: Phase) -> None:
        """Open a phase and wait until each of its trajectories is stored or quarantined.

        Raises RunFailed if all are quarantined.
        """
        self._open_phase(phase)
        self._reporter.phase_started()
        with self._lock:
            before, _ = self._scheduler.progress(phase.stage, phase.round)
        if not self._serving:  # not before the first phase is open: until then every trajectory would be unexpected
            self._link.serve(self._keys.data, self.ingest.put)
            self._serving = True
        began = time.monotonic()
        while True:
            with self._lock:
                arrived, expected = self._scheduler.progress(phase.stage, phase.round)
                done = self._scheduler.done(phase.stage, phase.round)
            per_s = (arrived - before) / max(1e-3, time.monotonic() - began)
            self._progress("collect", phase, arrived, expected, per_s=per_s, force=done)
            if done:
                break
            self._check()
            self._changed.wait(0.2)
            self._changed.clear()
        with self._lock:
            leases = self._scheduler.leases(phase.stage, phase.round)
            causes = dict(self._scheduler.quarantine_causes(phase.stage, phase.round))
            self._scheduler.close(phase.stage, phase.round)
            self._open_phases.discard(phase)
        self._plan.quarantine(causes)
        if not self.store.index.count(phase.stage, phase.round):
            raise RunFailed(
                f"{phase.stage}/{phase.round}: no trajectory was stored, and {len(causes)} of its variations are "
                f"quarantined; first: {next(iter(causes.values()))}"
            )
        self._metrics.write(phase.next_version, "collect", trajectories=arrived, per_s=per_s, leases=leases)
        if phase.next_version > self.version:
            rated = self._method.label_quality(self._run, phase, self.store)
            quality = training_rows.rate_labels(self._run, self._folder, phase, rated, self._note)
            if quality is not None:
                self._reporter.labels_rated(phase.round, quality)

    def _fit(self, phase: Phase) -> None:
        """Fit the model to the data of a phase, write its checkpoint and publish its weights."""
        self._metrics.continue_from(self.version, self._fitting.steps_done)
        draw = self._method.data(self._run, phase, self.store) if phase.steps else None
        began = time.monotonic()

        def report(step: int, loss: float) -> None:
            self._progress("fit", phase, step, phase.steps, loss=loss, force=step == phase.steps)
            if step % 50 == 0 or step == phase.steps:
                self._metrics.write(step, f"fit/{phase.next_version}", loss=loss)

        try:
            loss = self._fitting.fit(phase, draw, report, self._stop, self._check)
        except FloatingPointError as error:
            text = f"the fit of T^{phase.next_version} diverged: {error}"
            self._reporter.diverged(text)
            raise RunFailed(text + recovery.largest_values(self.store, self._spec, phase.next_version)) from None
        self.store.seal()
        weights = self._fitting.save(
            self._data.accept(self.store),
            loss=loss,
            dataset=self.store.manifest(),
            dataset_digest=self.store.digest(self.version),
            quarantined=self._plan.quarantined,
        )
        self._broadcast.publish(self._fitting.load() or weights)
        self._reporter.fitted(loss, time.monotonic() - began)

    def _report_repairs(self) -> None:
        """Report the damaged data that was removed when the dataset was opened."""
        self._repairs += len(self.store.damage)
        for note in self.store.damage:
            self._reporter.event({"event": "repaired", "text": note})

    def _check(self) -> None:
        """Raises the error of ``fail``, or Interrupted after ``stop``."""
        if self._error is not None:
            raise self._error
        if self._stop.is_set():
            raise Interrupted

    def _progress(self, what: str, phase: Phase, done: int, total: int, force: bool, **values: float) -> None:
        """Report the progress of a phase: ``what`` is ``collect`` or ``fit``; ``force`` as in ``Reporter.progress``."""
        fields: dict[str, Any] = {
            "stage": what,
            "round": phase.round,
            "phase": phase.stage,
            "step": done,
            "steps": total,
            "version": self.version,
            "trajectories": len(self.store),
            "workers": sum(self.worker_api.known.alive.values()),
            "lag": self._lag,
            "drops": dict(self.ingest.drops),
            "doing": self.worker_api.known.long_work,
            **values,
        }
        self._reporter.progress(fields, force, self.worker_api.known.totals)
