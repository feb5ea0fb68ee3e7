"""Estimate of a run's time, network and disk on N nodes, computed from measured rates.

In each phase workers collect whole jobs, their trajectories pass the learner's network and ingest,
and then only the learner works: it fits.
"""

from __future__ import annotations

import dataclasses
import json
import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from icrl_dist.config.toml import ConfigError


@dataclass(frozen=True)
class PhaseRates:
    """The amounts and the measured rates of one phase."""

    name: str
    """``pretrain/0``, ``adapt/1``."""
    jobs: int
    """Jobs; one worker does one job."""
    trajectories: int
    env_steps: int
    """Environment steps, summed over all jobs."""
    labels: int
    """Labeled query states, summed over all trajectories."""
    job_s: float
    """Seconds per job, on one worker."""
    message_bytes: float
    """Bytes per trajectory on the wire."""
    stored_bytes: float
    """Bytes per trajectory on the learner's disk."""
    fit_steps: int
    """Optimizer steps of the fit."""
    fit_step_s: float
    """Seconds per optimizer step, on the learner."""


@dataclass(frozen=True)
class Rates:
    """Everything that ``icrl-dist plan`` measures on one machine."""

    run: str
    machine: str
    cores: int
    phases: tuple[PhaseRates, ...]
    ingest_per_s: float
    """Trajectories per second that the learner stores durably."""
    weights_bytes: int
    """Bytes of the weights of one version, as a worker receives them."""
    checkpoint_bytes: int
    """Bytes of the checkpoint of one version on the learner's disk."""
    start_s: float
    """Seconds until the learner and the workers have started."""
    evaluate_s: float
    """Seconds of the evaluation at the end, on the learner."""

    def as_dict(self) -> dict[str, Any]:
        return dataclasses.asdict(self)

    @classmethod
    def read(cls, file: Path, run: str) -> Rates:
        """Read the output of ``icrl-dist plan --json``.  Raises ConfigError for another file, or for another run."""
        try:
            fields = json.loads(file.read_text().splitlines()[-1])["rates"]
            rates = cls(**{**fields, "phases": tuple(PhaseRates(**phase) for phase in fields["phases"])})
        except (OSError, ValueError, TypeError, KeyError, IndexError) as error:
            raise ConfigError(f"--rates {file}: not the output of `icrl-dist plan {run} --json` ({error})") from None
        if rates.run != run:
            raise ConfigError(f"--rates {file}: rates of {rates.run!r}, not of {run!r}; measure them for this run")
        return rates


def estimate(rates: Rates, nodes: int, cores: int, gbit_per_s: float) -> dict[str, Any]:
    """Hours, bytes and the first bottleneck with ``nodes`` nodes of ``cores`` workers each.

    Every worker is assumed to be as fast as the measured one.  ``gbit_per_s`` is the bandwidth of the
    learner's network.  Raises ConfigError for a number that is not above 0.
    """
    for name, value in (("nodes", nodes), ("cores", cores), ("gbit", gbit_per_s)):
        if not value > 0:
            raise ConfigError(f"--{name} {value}: must be above 0")
    workers = nodes * cores
    spent = dict.fromkeys(PARTS, 0.0)
    spent["start"], spent["evaluation"] = rates.start_s, rates.evaluate_s
    rows: list[dict[str, Any]] = []
    for phase in rates.phases:
        sizes = _collecting(phase, rates, workers, gbit_per_s)
        slowest = max(sizes, key=lambda name: sizes[name])
        collect, fit = sizes[slowest], phase.fit_steps * phase.fit_step_s
        spent[slowest] += collect
        spent["fit"] += fit
        rows.append({"phase": phase.name, "collect_s": round(collect, 1), "limit": slowest, "fit_s": round(fit, 1)})
    total = sum(spent.values())
    incoming = sum(p.trajectories * p.message_bytes for p in rates.phases)
    outgoing = len(rates.phases) * workers * rates.weights_bytes
    stored = sum(p.trajectories * p.stored_bytes for p in rates.phases) + len(rates.phases) * rates.checkpoint_bytes
    bottleneck = max(spent, key=lambda name: spent[name])
    return {
        "run": rates.run,
        "nodes": nodes,
        "workers": workers,
        "hours": total / 3600,
        "phases": rows,
        "seconds": {name: round(value, 1) for name, value in spent.items()},
        "network_bytes": round(incoming + outgoing),
        "network_peak_mbit_per_s": round(max(_peak(p, row["collect_s"]) for p, row in zip(rates.phases, rows, strict=True)), 1),
        "disk_bytes": round(stored),
        "bottleneck": bottleneck,
        "why": PARTS[bottleneck],
        "useful_workers": max(phase.jobs for phase in rates.phases),
        "env_steps_per_s": round(sum(p.env_steps for p in rates.phases) / sum(p.jobs * p.job_s for p in rates.phases), 1),
        "labels_per_s": round(_labels_per_s(rates), 1),
        "bytes_a_trajectory": round(incoming / sum(p.trajectories for p in rates.phases)),
        "ingest_per_s": round(rates.ingest_per_s, 1),
    }


PARTS = {
    "collecting": "more nodes shorten it, up to useful_workers",
    "jobs": "fewer jobs than workers: use smaller jobs (stream.job_tasks)",
    "ingest": "storing trajectories on the learner: a faster disk and core help, more nodes do not",
    "network": "the learner's network: more bandwidth helps, more nodes do not",
    "fit": "only the learner works: a GPU or a faster head helps, more nodes do not",
    "evaluation": "only the learner works, at the end: reduce evaluate.episodes or evaluate.seeds",
    "start": "starting processes and imports: the run is too short for a cluster",
}
"""The parts of a run's time, and what reduces each."""


def _collecting(phase: PhaseRates, rates: Rates, workers: int, gbit_per_s: float) -> dict[str, float]:
    """Seconds that the collection of the phase would take if only this limit applied, by limit."""
    turns = math.ceil(phase.jobs / workers) * phase.job_s
    return {
        "jobs" if workers > phase.jobs else "collecting": turns,
        "ingest": phase.trajectories / rates.ingest_per_s,
        "network": (phase.trajectories * phase.message_bytes + workers * rates.weights_bytes) * 8 / (gbit_per_s * 1e9),
    }


def _peak(phase: PhaseRates, seconds: float) -> float:
    """Mbit/s that the learner receives while the phase is collected."""
    return phase.trajectories * phase.message_bytes * 8e-6 / max(seconds, 1e-3)


def _labels_per_s(rates: Rates) -> float:
    """Labeled states per second of one worker, in the phases with labels."""
    labeled = [p for p in rates.phases if p.labels]
    return sum(p.labels for p in labeled) / sum(p.jobs * p.job_s for p in labeled) if labeled else 0.0


def describe(plan: Mapping[str, Any]) -> str:
    """The estimate as text."""
    hours = plan["hours"]
    duration = f"{hours:.1f} hours" if hours >= 1 else f"{hours * 60:.1f} minutes"
    parts = {name: seconds for name, seconds in plan["seconds"].items() if seconds}
    lines = [f"{plan['run']} with {plan['workers']} workers on {plan['nodes']} nodes: {duration}"]
    lines += [f"  {name:<11}{seconds:>10.0f} s  {seconds / hours / 36:>3.0f}%" for name, seconds in parts.items()]
    for row in plan["phases"]:
        lines.append(f"  {row['phase']:<11} collect {row['collect_s']:.0f} s (by {row['limit']}), fit {row['fit_s']:.0f} s")
    lines += [
        f"network  {plan['network_bytes'] / 1e9:.3g} GB, at most {plan['network_peak_mbit_per_s']:.3g} Mbit/s to the learner",
        f"disk     {plan['disk_bytes'] / 1e9:.3g} GB on the head",
        f"rates    per worker {plan['env_steps_per_s']:,.0f} environment steps/s, {plan['labels_per_s']:,.0f} labels/s, "
        f"{plan['bytes_a_trajectory']:,} bytes per trajectory, {plan['ingest_per_s']:,.0f} trajectories/s into the learner",
        f"first bottleneck: {plan['bottleneck']} ({plan['why']})",
        f"at most {plan['useful_workers']} workers have a job at the same time",
    ]
    return "\n".join(lines)
