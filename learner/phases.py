"""The phases of a run: their jobs, and which trajectories of them are stored."""

from __future__ import annotations

from icrl_dist.collect.checks import Rejected, check_arrays
from icrl_dist.config.run import Run
from icrl_dist.interfaces import Method, Phase
from icrl_dist.problems import registry
from icrl_dist.storage.dataset import Dataset
from icrl_dist.storage.files import StoreError
from icrl_dist.storage.fork import Lineage
from icrl_dist.types import Identity, Job, Trajectory


class PhasePlan:
    """The phases of a method, and how much data of each the dataset holds."""

    store: Dataset
    """Set before any method but ``ask`` and ``job_of`` is called."""

    def __init__(self, run: Run, lineage: Lineage, method: Method) -> None:
        self.method = method
        """The method that makes the jobs."""
        self.phases = self.method.phases(run)
        self.quarantined: dict[str, str] = {}
        """The cause of each quarantined variation, by its name, such as ``adapt/0/3/1``."""
        self._problem = registry.of(run)
        self._staleness, self._lineage = run.stream.staleness, lineage
        self._complete: set[Phase] = set()
        self._jobs: dict[Phase, tuple[Job, ...]] = {}
        self._job_of: dict[tuple[str, int, int, int], Job] = {}

    def ask(self, phase: Phase) -> tuple[Job, ...]:
        """The jobs of a phase, computed once, with the settings of the run that first collected it."""
        if phase not in self._jobs:
            self._jobs[phase] = self.method.ask(self._lineage.run_of(phase.next_version), phase)
            self._job_of.update(((phase.stage, phase.round, *row), job) for job in self._jobs[phase] for row in job.rows())
        return self._jobs[phase]

    def job_of(self, identity: Identity) -> Job | None:
        """The job that asks for this trajectory; None if the run has none."""
        for phase in self.phases:
            if (phase.stage, phase.round) == identity[:2]:
                self.ask(phase)
        job = self._job_of.get(identity[:4])
        return job if job is not None and identity.trial < job.trials else None

    def refusal(self, trajectory: Trajectory) -> str:
        """Why a stored trajectory cannot be used, so that it is collected again; empty if it can.

        Raises StoreError for one that this run did not ask for.
        """
        identity = trajectory.identity
        job = self.job_of(identity)
        if job is None or trajectory.variation != job.variation(identity):
            raise StoreError(
                f"dataset: {identity} is of another run, this one asks for no such trajectory: restore the right segment or "
                "run.toml, or start a new run with another --out"
            )
        try:
            check_arrays(trajectory, job, self._problem.spec, self._problem.limits)
        except Rejected as error:
            return str(error)
        return ""

    def next(self, version: int) -> Phase | None:
        """The first phase that is not fitted, or whose data is not complete; ``version``: the newest one."""
        return next((phase for phase in self.phases if phase.next_version > version or not self.is_complete(phase)), None)

    def recheck(self) -> None:
        """Drop what is known of the data of all phases, because the store may have lost some of it."""
        self._drop_quarantined()
        self._complete.clear()

    def is_complete(self, phase: Phase) -> bool:
        """Whether all trajectories of the phase are stored, apart from quarantined variations."""
        if phase not in self._complete and self._all_stored(phase):
            self._complete.add(phase)
        return phase in self._complete

    def _all_stored(self, phase: Phase) -> bool:
        jobs = self.ask(phase)
        expected = sum(job.trials * sum(_name(job, *row) not in self.quarantined for row in job.rows()) for job in jobs)
        return self.store.index.count(phase.stage, phase.round) >= expected

    def incomplete(self, phase: Phase) -> list[Job]:
        """The jobs of the phase with missing trajectories."""
        return [job for job in self.ask(phase) if len(self.not_needed(job)) < job.trials * len(job.variations)]

    def ahead(self, phase: Phase, version: int) -> list[Phase]:
        """The later phases whose jobs may be leased during this one, by ``stream.staleness``; ``version``: the newest one."""
        newest = version + self._staleness
        return [
            p
            for p in self.phases
            if p.next_version > max(version, phase.next_version) and version >= 0 and p.policy_version <= newest
        ]

    def not_needed(self, job: Job) -> list[Identity]:
        """The identities of a job that need not be collected: stored ones and those of quarantined variations."""
        stored = self.store.index.identities(job.stage, job.round, (job.task, job.task + job.tasks))
        quarantined = {row for row in job.rows() if _name(job, *row) in self.quarantined}
        return stored + [i for i in job.identities() if (i.task, i.variation) in quarantined]

    def policy_version(self, job: Job, version: int) -> int:
        """The policy version that acts in a job: the job's own, or the newest (``version``) while rounds overlap.

        The same T^j acts in all trials of a job, so the version in its stored trajectories has priority.
        """
        if job.policy_version < 0:
            return job.policy_version
        stored = self.store.index.policy_versions(job.stage, job.round, (job.task, job.task + job.tasks))
        return stored[0] if stored else min(version, job.policy_version)

    def quarantine(self, variations: dict[str, str]) -> None:
        """Leave these variations (name: cause) out from now on."""
        self.quarantined.update(variations)
        self._drop_quarantined()

    def _drop_quarantined(self) -> None:
        """Remove their trials from the index, because which of them are stored depends on the timing of workers."""
        for name in self.quarantined:
            stage, *numbers = name.split("/")
            round_, task, variation = map(int, numbers)
            self.store.index.drop((stage, round_, task, variation))


def _name(job: Job, task: int, variation: int) -> str:
    return f"{job.stage}/{job.round}/{task}/{variation}"
