"""When and where each fault strikes, as a function of a seed."""

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
    "flip-byte": "a byte of a sealed segment changes, after kill-tree or during the run",
    "full-disk": "a disk too small for the run, enlarged, then --resume",
    "strangers": "1,500 connections to the learner's port that send nothing",
    "stop-run": "SIGSTOP of the command and of Ray for 15 s, as Ctrl-Z does",
    "kill-raylet": "SIGKILL of Ray's raylet and of all workers",
    "kill-gcs": "SIGKILL of Ray's GCS",
    "hang-up": "SIGHUP of the command, then --resume",
    "kill-run": "SIGKILL of the command alone, then --resume",
    "flip-checkpoint": "kill-tree, and a bit of the newest checkpoint changes",
}
"""Every fault with its description.  A new one comes last: its number is part of the key of its schedule."""

IN_FITS = ("kill-learner", "stop-run", "kill-raylet", "kill-gcs", "hang-up", "kill-run")
"""The faults that strike during a fit too."""

_AFTER = (0.1, 0.5)
"""Range of the share of a phase after which a strike falls, so that it interrupts the phase."""


@dataclass(frozen=True)
class Strike:
    """The drawn parameters of one fault."""

    fault: str
    phase: int
    """Number of the run's phase, from 0."""
    name: str
    """That phase's name, such as ``adapt/0``."""
    fit: bool
    """Whether it strikes during the phase's fit; otherwise during collection."""
    after: int
    """Trajectories of the phase, or steps of its fit, before the strike."""
    of: int
    """All trajectories of the phase, or all steps of its fit."""
    worker: int
    """Number of the worker, modulo the number of workers."""
    place: float
    """Place in a segment or a frame, or size of the disk, as a share."""
    variant: bool
    """Variant: half a frame added (else a tail cut off), a byte changed during the run (else after a kill)."""

    def __str__(self) -> str:
        where = f"fit of {self.name}, step" if self.fit else self.name
        return f"{where} {self.after}/{self.of}"


def draw(run: Run, seed: int, fault: str, attempt: int = 0) -> Strike:
    """The strike of one fault; another ``attempt`` gives another strike.

    Raises ConfigError for a fault that cannot strike this run.
    """
    rng = np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(list(FAULTS).index(fault), attempt)))
    method = methods.of(run)
    phases = method.phases(run)
    first = 1 if fault in ("flip-byte", "flip-checkpoint") else 0
    if first >= len(phases):
        raise ConfigError(
            f"--faults {fault}: {run.method} has one phase, so there is nothing sealed before its end; list others"
        )
    number = int(rng.integers(first, len(phases)))
    phase = phases[number]
    share, place = rng.uniform(*_AFTER), float(rng.random())
    worker, variant = int(rng.integers(1 << 16)), bool(rng.integers(2))
    fit = fault in IN_FITS and variant and phase.steps > 1
    of = phase.steps if fit else sum(job.trials * len(job.variations) for job in method.ask(run, phase))
    return Strike(fault, number, f"{phase.stage}/{phase.round}", fit, max(1, round(share * of)), of, worker, place, variant)
