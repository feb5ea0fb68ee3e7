"""When and where each fault strikes: a function of a seed, and of nothing else."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from icrl_dist.config.run import ConfigError, Run
from icrl_dist.methods import registry as methods

FAULTS = {
    "kill-worker": "SIGKILL of a worker",
    "kill-learner": "SIGKILL of the learner",
    "kill-tree": "SIGKILL of the whole process tree, then --resume",
    "stop-learner": "SIGSTOP of the learner for 15 s",
    "cut-link": "the link between workers and learner cut for 12 s",
    "torn-tail": "kill-tree, and the newest segment ends in half a frame",
    "flip-byte": "a byte of a sealed segment changes, after kill-tree or while the run is on",
    "full-disk": "a run folder too small for the run, made larger, then --resume",
}
"""Every fault, and what it is."""

_AFTER = (0.1, 0.5)
"""A strike falls after this share of a phase, at least and at most: what it hits is under way then."""


@dataclass(frozen=True)
class Strike:
    """One fault's drawn numbers."""

    fault: str
    phase: int
    """Which phase of the run, counted from 0."""
    name: str
    """That phase's name, such as ``adapt/0``."""
    fit: bool
    """Whether it strikes in the phase's fit, else while trajectories are collected."""
    after: int
    """Trajectories of the phase heard before, or steps of its fit."""
    of: int
    """Trajectories of the phase, or steps of its fit, in all."""
    worker: int
    """Which worker, counted round and round."""
    place: float
    """Where in a segment, a frame, or how large a disk: a share."""
    odd: bool
    """Which of two ways: a tail cut off or half a frame added, a byte changed in a live or in a killed run."""

    def __str__(self) -> str:
        where = f"fit of {self.name}, step" if self.fit else self.name
        return f"{where} {self.after}/{self.of}"


def draw(run: Run, seed: int, fault: str, attempt: int = 0) -> Strike:
    """The strike of one fault; a new ``attempt`` draws anew.

    Raises ConfigError for a fault that this run gives no chance to.
    """
    rng = np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(list(FAULTS).index(fault), attempt)))
    method = methods.of(run)
    phases = method.phases(run)
    first = 1 if fault == "flip-byte" else 0
    if first >= len(phases):
        raise ConfigError(f"--faults {fault}: {run.method} has one phase, and its segment is sealed at the end; leave it out")
    number = int(rng.integers(first, len(phases)))
    phase = phases[number]
    share, place = rng.uniform(*_AFTER), float(rng.random())
    worker, odd = int(rng.integers(1 << 16)), bool(rng.integers(2))
    fit = fault == "kill-learner" and odd and phase.steps > 1
    of = phase.steps if fit else sum(job.trials * len(job.variations) for job in method.ask(run, phase))
    return Strike(fault, number, f"{phase.stage}/{phase.round}", fit, max(1, round(share * of)), of, worker, place, odd)
