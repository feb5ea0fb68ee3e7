"""What a run still needs: its phases, the jobs of each, and what the store holds of them."""

from __future__ import annotations

from icrl_dist.config.run import Run
from icrl_dist.interfaces import Method, Phase
from icrl_dist.storage.dataset import Dataset
from icrl_dist.storage.fork import Lineage
from icrl_dist.types import Identity, Job


class PhasePlan:
    """A method's phases and what the dataset holds of each."""

    def __init__(self, run: Run, lineage: Lineage, store: Dataset, method: Method, given_up: dict[str, str]) -> None:
        self.method = method
        self.phases = self.method.phases(run)
        self.given_up = given_up
        """Variations that are quarantined, ``adapt/0/3/1``, and why."""
        self._staleness, self._lineage, self._store = run.stream.staleness, lineage, store
        self._whole: set[Phase] = set()
        self._asked: dict[Phase, tuple[Job, ...]] = {}

    def ask(self, phase: Phase) -> tuple[Job, ...]:
        """The phase's jobs, computed once, with the numbers of the run that first collected it."""
        if phase not in self._asked:
            self._asked[phase] = self.method.ask(self._lineage.run_of(phase.next_version), phase)
        return self._asked[phase]

    def next(self, version: int) -> Phase | None:
        """The first phase that is not fitted, or whose data is not whole, given the newest version."""
        return next((phase for phase in self.phases if phase.next_version > version or not self.whole(phase)), None)

    def look_again(self) -> None:
        """Look at every phase's data once more, for some may have been lost."""
        self._whole.clear()

    def whole(self, phase: Phase) -> bool:
        """Whether nothing of the phase is missing."""
        if phase not in self._whole and self._count(phase):
            self._whole.add(phase)
        return phase in self._whole

    def _count(self, phase: Phase) -> bool:
        expected = sum(job.trials * sum(_name(job, *row) not in self.given_up for row in job.rows()) for job in self.ask(phase))
        return self._store.index.count(phase.stage, phase.round) >= expected

    def incomplete(self, phase: Phase) -> list[Job]:
        """The phase's jobs of which something is missing."""
        return [job for job in self.ask(phase) if len(self.have(job)) < job.trials * len(job.variations)]

    def ahead(self, phase: Phase, version: int) -> list[Phase]:
        """The phases after this one whose work may go out already: ``stream.staleness``."""
        newest = version + self._staleness
        return [
            p
            for p in self.phases
            if p.next_version > max(version, phase.next_version) and version >= 0 and p.policy_version <= newest
        ]

    def have(self, job: Job) -> list[Identity]:
        """What need not be asked for: what is stored, and what was given up before."""
        stored = self._store.index.identities(job.stage, job.round, (job.task, job.task + job.tasks))
        given_up = {row for row in job.rows() if _name(job, *row) in self.given_up}
        return stored + [i for i in job.identities() if (i.task, i.variation) in given_up]

    def acting(self, job: Job, version: int) -> int:
        """The version that acts in a job: its own, or the newest while rounds overlap.

        One T^j acts in all trials of a job, so what is stored of it decides.
        """
        if job.policy_version < 0:
            return job.policy_version
        acted = self._store.index.policy_versions(job.stage, job.round, (job.task, job.task + job.tasks))
        return acted[0] if acted else min(version, job.policy_version)

    def give_up(self, variations: dict[str, str]) -> None:
        """Leave variations out from now on; some of their trials may be there, and which ones is chance."""
        self.given_up.update(variations)
        for name in self.given_up:
            stage, *numbers = name.split("/")
            round_, task, variation = map(int, numbers)
            self._store.index.drop((stage, round_, task, variation))


def _name(job: Job, task: int, variation: int) -> str:
    return f"{job.stage}/{job.round}/{task}/{variation}"
