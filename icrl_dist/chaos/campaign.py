"""A campaign: an undisturbed run, then one run for every fault of every schedule."""

from __future__ import annotations

import dataclasses
import signal
import threading
import time
from collections.abc import Sequence
from pathlib import Path
from types import TracebackType
from typing import Any, Self

from rich.console import Console

from icrl_dist.chaos import schedule
from icrl_dist.chaos.disk import NoDisk
from icrl_dist.chaos.faults import FAULTS
from icrl_dist.chaos.outcome import SAME, Outcome, ReferenceRun, summary, table, verdict
from icrl_dist.chaos.striking import Missed
from icrl_dist.chaos.training import Training, TrainingFailed
from icrl_dist.config.run import ConfigError, load, override, validate
from icrl_dist.launch import run_folder

TRIES = 4
"""Strikes that are drawn for a fault, at most, until one lands."""

BRIEF = ("evaluate.episodes=1", "evaluate.seeds=1", "evaluate.p=[0.0]")
"""Settings that shorten the evaluation, which does not change the digests."""

FIRST_LIMIT_S = 3600.0
"""Time limit of the undisturbed run; a disturbed run may take five times its duration plus two minutes."""


class Campaign:
    """Faults on one run.  In this context SIGTERM raises KeyboardInterrupt, so that everything is cleaned up."""

    def __init__(self, name: str, settings: Sequence[str], actors: int, out: Path, console: Console) -> None:
        """``name`` and ``settings`` are RUN and ``--set`` of ``icrl-dist train``.  Raises ConfigError as that does."""
        self._settings = (*settings, *BRIEF)
        self.config = override(load(name), self._settings, "--set")
        validate(self.config, name)
        self._name = str(Path(name).absolute()) if Path(name).is_file() else name
        self._actors, self._out, self._console = actors, out.absolute(), console
        self._status = console.status("")

    def __enter__(self) -> Self:
        in_main_thread = threading.current_thread() is threading.main_thread()
        self._before = signal.signal(signal.SIGTERM, signal.default_int_handler) if in_main_thread else None
        self._status.start()
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        self._status.stop()
        if self._before is not None:
            signal.signal(signal.SIGTERM, self._before)

    def run(self, faults: str, seeds: Sequence[int], reference: Path | None) -> dict[str, Any]:
        """Run the campaign, print its progress and a table, and return the ``summary``.

        ``faults``: names separated by commas; empty for all.  Raises ConfigError for an unknown
        fault or one that cannot strike this run, TrainingFailed if the undisturbed run fails.
        """
        began = time.monotonic()
        names = [name.strip() for name in faults.split(",")] if faults else list(FAULTS)
        for name in names:
            if name not in FAULTS:
                raise ConfigError(f"--faults {name}: unknown fault; choose from {', '.join(FAULTS)}")
            schedule.draw(self.config, 0, name)
        known = ReferenceRun.of(reference, self.config) if reference is not None else self.undisturbed()
        self._print(f"undisturbed: {_digests(known.result)}, {known.seconds:.0f} s")
        outcomes = [self.strike(seed, name, known) for seed in seeds for name in names]
        self._status.stop()
        self._console.print(table(outcomes))
        self._print(verdict(outcomes))
        return summary(outcomes, known, time.monotonic() - began)

    def undisturbed(self) -> ReferenceRun:
        """Run the training once, without a fault.  Raises TrainingFailed if it fails."""
        self._status.update("undisturbed")
        with self._training(self._out / "undisturbed", FIRST_LIMIT_S) as training:
            training.start()
            training.result()
        return ReferenceRun.of(training.folder, self.config)

    def strike(self, seed: int, fault: str, reference: ReferenceRun) -> Outcome:
        """One fault of one schedule; a new strike is drawn while the last one has not landed."""
        began = time.monotonic()
        for attempt in range(TRIES):
            planned = schedule.draw(self.config, seed, fault, attempt)
            self._status.update(f"seed {seed}, {schedule.FAULTS[fault]}; due at {planned}, attempt {attempt + 1}")
            with self._training(self._out / f"seed-{seed}" / fault, 5 * reference.seconds + 120) as training:
                outcome, again = self._once(seed, training, planned, reference)
            if not again:
                break
        if outcome.ok:
            _clear(training)
        else:
            outcome = dataclasses.replace(outcome, folder=str(training.folder))
        outcome = dataclasses.replace(outcome, seconds=round(time.monotonic() - began, 1), attempts=attempt + 1)
        self._print(f"seed {seed}, {fault}: {'as undisturbed' if outcome.ok else 'FAILED'}, {outcome.seconds:.0f} s")
        return outcome

    def _once(self, seed: int, training: Training, strike: schedule.Strike, reference: ReferenceRun) -> tuple[Outcome, bool]:
        """The outcome of one strike, and whether to draw another: if it hit nothing and changed nothing."""
        try:
            found = FAULTS[strike.fault](training, strike, reference.disk_bytes)
        except Missed as error:
            return Outcome(seed, strike.fault, f"due at {strike}", False, str(error), False), True
        except TrainingFailed as error:
            return Outcome(seed, strike.fault, f"due at {strike}", False, str(error), False), False
        except NoDisk as error:
            text = f"no tmpfs can be mounted ({error}): run as root, or list the other faults with --faults"
            return Outcome(seed, strike.fault, "", False, text, False), False
        equal = reference.equals(found.result)
        evidence = found.evidence if equal else f"{found.evidence}; {_digests(found.result)}"
        return Outcome(seed, strike.fault, found.where, found.landed, evidence, equal), equal and not found.landed

    def _training(self, folder: Path, limit_s: float) -> Training:
        folder.parent.mkdir(parents=True, exist_ok=True)
        training = Training(self._name, self.config, self._settings, folder, self._actors, limit_s)
        _clear(training)
        return training

    def _print(self, text: str) -> None:
        self._console.print(text, highlight=False, markup=False)


def _digests(result: dict[str, Any]) -> str:
    dataset, weights, trajectories = (str(result[name])[:16] for name in SAME)
    return f"dataset {dataset}, weights {weights}, {trajectories} trajectories"


def _clear(training: Training) -> None:
    """Remove the run folder and the log of a finished training.  Raises ConfigError if the folder has foreign files."""
    run_folder.remove(training.folder)
    training.log.unlink(missing_ok=True)
