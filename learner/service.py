"""The learner: hand out a phase's work, take it in, fine-tune, broadcast, and so on."""

from __future__ import annotations

import contextlib
import os
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch

from icrl_dist.config.random_keys import RandomKey, generator
from icrl_dist.config.run import Run
from icrl_dist.interfaces import Phase
from icrl_dist.methods import registry as methods
from icrl_dist.problems import registry
from icrl_dist.storage import checkpoint, files
from icrl_dist.storage.dataset import Damaged, Dataset
from icrl_dist.storage.fork import Lineage
from icrl_dist.stream.link import Link, StreamKeys
from icrl_dist.telemetry.metrics import Metrics
from icrl_dist.training import fit
from icrl_dist.types import Identity, Job, Trajectory, Weights
from learner import checkpoints
from learner.broadcast import Broadcast
from learner.ingest import Ingest
from learner.phases import PhasePlan
from learner.reporter import Reporter
from learner.scheduler import LeaseScheduler
from learner.worker_api import WorkerAPI

Report = Callable[[dict[str, Any]], None]


class RunFailed(RuntimeError):  # noqa: N818
    """The run cannot go on; the message is one line for the user."""


class Interrupted(Exception):  # noqa: N818
    """The run was asked to stop; a checkpoint has been written."""


class Service:
    """One run's learner.  ``report`` receives what happens as plain dicts, for a terminal."""

    def __init__(self, run: Run, folder: Path, link: Link, report: Report) -> None:
        """Opens the run folder and takes up where its checkpoints and dataset end.

        Raises StoreError if another learner is at work there, or if it cannot be used.
        """
        self._run, self._folder, self._link, self._report = run, folder, link, report
        with contextlib.ExitStack() as closing:
            closing.enter_context(files.hold(folder))
            self._begin(closing)
            self._closing = closing.pop_all()

    def _begin(self, closing: contextlib.ExitStack) -> None:
        run, folder, link, report = self._run, self._folder, self._link, self._report
        self._keys = StreamKeys(folder.name)
        self._spec = registry.of(run).spec
        lineage = Lineage.of(folder, run)
        self._threads = run.learner.threads or len(os.sched_getaffinity(0))
        torch.manual_seed(run.seed)
        torch.set_deterministic_debug_mode("error")  # as use_deterministic_algorithms, which imports torch's compiler
        self._device = _device(run.learner.device)
        self._method = methods.of(run)
        self.model = self._method.build(self._spec, run).to(self._device)
        self._opt = fit.Optimizer(self.model, run.optim)
        self.version = checkpoint.newest_version(folder)
        self._partial = 0
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
        self._mended = 0
        self.store = Dataset(folder / "dataset")
        closing.callback(self.store.close)
        self._tell_repairs()
        self._plan = PhasePlan(run, lineage, self.store, self._method, {})
        self._plan.give_up(checkpoints.given_up(folder, self.version))
        self._opened: set[Phase] = set()
        self._broadcast = Broadcast(link, self._keys, self._older)
        self.ingest = Ingest(
            self.store,
            self._spec,
            run.stream.max_message_bytes,
            self._wants,
            self._broadcast.digest_of,
            self._stored,
            self.fail,
        )
        closing.callback(self.ingest.close)
        acting = lambda job: self._plan.acting(job, self.version)  # noqa: E731
        fail = lambda line: self.fail(RunFailed(line))  # noqa: E731
        report = self._reporter.event
        self.worker_api = WorkerAPI(run, folder, link, self._keys, self._scheduler, self._lock, report, fail, acting)
        closing.callback(self.worker_api.close)
        self._taking = False
        self._take_up()

    @property
    def device(self) -> str:
        """Where fits run, and with what: ``cuda, NVIDIA H100``, ``cpu, 2 threads``."""
        kind = self._device
        return f"cuda, {torch.cuda.get_device_name(kind)}" if kind.type == "cuda" else f"cpu, {self._threads} threads"

    # What other threads call.

    def stop(self) -> None:
        """Ask the run to end soon, with a checkpoint."""
        self._stop.set()
        self._changed.set()

    def fail(self, error: BaseException) -> None:
        """End the run with this error."""
        self._error = error
        self._changed.set()

    def _wants(self, identity: Identity) -> Job | None:
        with self._lock:
            job = self._scheduler.pending_job(identity)
            if job is None:
                self._scheduler.repeated(identity, time.monotonic())
            return job

    def _stored(self, trajectory: Trajectory) -> None:
        identity = trajectory.identity
        with self._lock:
            self._scheduler.received(identity, time.monotonic())
            done = self._scheduler.done(identity.stage, identity.round)
        if identity.stage == "adapt":
            self._lag = identity.round - trajectory.policy_version
        self._reporter.stored(trajectory)
        if done:
            self._changed.set()

    def _older(self, version: int) -> Weights:
        return checkpoints.weights_of_file(checkpoint.version_file(self._folder, version), version)

    # The run, on the caller's thread.

    def run(self) -> dict[str, Any]:
        """Go through the method's phases to the end; returns the result that was stored.

        Raises Interrupted after ``stop`` (a checkpoint has been written), RunFailed or
        StoreError if the run cannot go on.
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
        while (phase := self._plan.next(self.version)) is not None:
            if phase.next_version <= self.version:
                lost = ", ".join(job.label for job in self._plan.incomplete(phase))
                self._reporter.event({"event": "note", "text": f"trajectories of {lost} are missing: collecting them again"})
            try:
                self._collect(phase)
                if phase.next_version > self.version:
                    self._fit(phase)
            except Damaged as error:
                self._reporter.event({"event": "note", "text": str(error)})
                self.store.repair()
                self._tell_repairs()
                self._plan.give_up({})
                self._plan.look_again()
        self.store.seal()
        return {
            "dataset_digest": self.store.digest(),
            "weights_digest": self._broadcast.digest_of(self.version),
            "version": self.version,
            "trajectories": len(self.store),
            "drops": dict(self.ingest.drops),
            "resent": self.worker_api.resent,
            "repaired": self._mended,
            "quarantined": [{"variation": name, "cause": cause} for name, cause in self._plan.given_up.items()],
            "staleness": self._run.stream.staleness,
            "lag": {str(lag): count for lag, count in self.store.index.lags().items()},
            "threads": self._threads,
            "instruction_set": torch.backends.cpu.get_cpu_capability(),
        }

    def close(self) -> None:
        """Stop taking in and let go of the files."""
        self._closing.close()

    def _open(self, phase: Phase) -> None:
        """Put a phase's work on the LeaseScheduler, and that of phases which may run ahead of it."""
        for one in (phase, *self._plan.ahead(phase, self.version)):
            if one not in self._opened:
                jobs = self._plan.ask(one)
                with self._lock:
                    self._scheduler.open(jobs, self._plan.have)
                self._opened.add(one)

    def _collect(self, phase: Phase) -> None:
        self._open(phase)
        self._reporter.phase_started()
        with self._lock:
            already, _ = self._scheduler.progress(phase.stage, phase.round)
        if not self._taking:  # earlier, nothing was expected yet: what comes meanwhile is sent again
            self._link.serve(self._keys.data, self.ingest.put)
            self._taking = True
        began = time.monotonic()
        while True:
            with self._lock:
                arrived, expected = self._scheduler.progress(phase.stage, phase.round)
                done = self._scheduler.done(phase.stage, phase.round)
            per_s = (arrived - already) / max(1e-3, time.monotonic() - began)
            self._progress("collect", phase, arrived, expected, per_s=per_s, force=done)
            if done:
                break
            self._check()
            self._changed.wait(0.2)
            self._changed.clear()
        with self._lock:
            leases = self._scheduler.leases(phase.stage, phase.round)
            blamed = dict(self._scheduler.quarantine_causes(phase.stage, phase.round))
            self._scheduler.close(phase.stage, phase.round)
            self._opened.discard(phase)
        self._plan.give_up(blamed)
        if not self.store.index.count(phase.stage, phase.round):
            raise RunFailed(
                f"{phase.stage}/{phase.round}: no trajectory was stored, and {len(blamed)} of its variations are "
                f"quarantined; first: {next(iter(blamed.values()))}"
            )
        self._metrics.write(self.version + 1, "collect", trajectories=arrived, per_s=per_s, leases=leases)
        quality = self._method.label_quality(self._run, phase, self.store) if phase.next_version > self.version else {}
        if quality:
            self._reporter.labels_rated(phase.round, quality)

    def _fit(self, phase: Phase) -> None:
        draw = self._method.data(self._run, phase, self.store) if phase.steps else None
        optim, torch_threads = self._run.optim, torch.get_num_threads()
        torch.set_num_threads(self._threads)
        began = time.monotonic()
        partial = self._folder / "checkpoints" / checkpoints.PARTIAL

        def loss_of(step: int) -> torch.Tensor:
            assert draw is not None
            rng = generator(self._run.seed, RandomKey.FIT, phase.next_version, step)
            torch.manual_seed(int(rng.integers(2**31)))
            return self._method.loss(self.model, draw(rng))

        def progress(step: int, loss: float) -> None:
            self._partial = step  # damage may end this fit: it is taken up from here
            self._progress("fit", phase, step, phase.steps, loss=loss, force=step == phase.steps)
            if step % 50 == 0 or step == phase.steps:
                self._metrics.write(step, f"fit/{phase.next_version}", loss=loss)
            if self._stop.is_set() or step % 1000 == 0:
                self._save(partial, self._weights(), next_version=phase.next_version, step=step)
            self._check()

        first = self._partial
        try:
            loss = fit.fit(self.model, self._opt, optim, phase.learning_rate, phase.steps, loss_of, progress, first)
        finally:
            torch.set_num_threads(torch_threads)
        self._partial = 0
        self.version = phase.next_version
        self.store.seal()
        where = {
            "dataset": self.store.manifest(),
            "dataset_digest": self.store.digest(self.version),
            "quarantined": self._plan.given_up,
        }
        weights = self._weights()
        self._save(checkpoint.version_file(self._folder, self.version), weights, loss=loss, **where)
        partial.unlink(missing_ok=True)
        self._broadcast.publish(weights)
        self._reporter.fitted(loss, time.monotonic() - began)

    def _weights(self) -> Weights:
        """The model's parameters, hashed once."""
        return checkpoints.weights(self.version, self.model)

    def _save(self, path: Path, weights: Weights, **where: object) -> None:
        about = checkpoints.manifest(self._run, self._spec, self.version, self._threads)
        checkpoints.save(path, weights, self._opt, {**about, **where})

    def _take_up(self) -> None:
        """Continue from the newest version, and from the fit that was interrupted, if there are any."""
        if self.version >= 0:
            checkpoints.restore(checkpoint.version_file(self._folder, self.version), self._spec, self.model, self._opt)
            self._broadcast.publish(self._weights())
        partial = self._folder / "checkpoints" / checkpoints.PARTIAL
        if partial.exists() and checkpoints.read_manifest(partial)["next_version"] == self.version + 1:
            self._partial = checkpoints.restore(partial, self._spec, self.model, self._opt)["step"]

    def _tell_repairs(self) -> None:
        self._mended += len(self.store.repaired)
        for note in self.store.repaired:
            self._reporter.event({"event": "repaired", "text": note})

    def _check(self) -> None:
        if self._error is not None:
            raise self._error
        if self._stop.is_set():
            raise Interrupted

    def _progress(self, what: str, phase: Phase, done: int, total: int, force: bool, **values: float) -> None:
        fields: dict[str, Any] = {
            "stage": what,
            "round": phase.round,
            "phase": phase.stage,
            "step": done,
            "steps": total,
            "version": self.version,
            "trajectories": len(self.store),
            "workers": sum(self.worker_api.workers.values()),
            "lag": self._lag,
            "drops": dict(self.ingest.drops),
            "doing": self.worker_api.long_work,
            **values,
        }
        self._reporter.progress(fields, force, self.worker_api.totals)


def _device(name: str) -> torch.device:
    if name == "cuda" and not torch.cuda.is_available():
        raise RunFailed("learner.device = 'cuda': no GPU is seen by torch; use auto or cpu")
    return torch.device("cuda" if name != "cpu" and torch.cuda.is_available() else "cpu")
