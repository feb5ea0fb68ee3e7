"""What a run will take on N machines: arithmetic over measured rates, nothing else.

A phase is collected by workers that take whole jobs, goes through one learner's inbox and the
network in front of it, and is then fitted by the learner alone.
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
    """A phase: how much there is of everything, and how fast each part of it goes."""

    name: str
    """``pretrain/0``, ``adapt/1``."""
    jobs: int
    """Jobs, each done by one worker."""
    trajectories: int
    env_steps: int
    """Environment steps, of all its jobs together."""
    labels: int
    """Labelled query states, of all its trajectories together."""
    job_s: float
    """Seconds a job, on one worker."""
    message_bytes: float
    """Bytes a trajectory on the wire."""
    stored_bytes: float
    """Bytes a trajectory on the learner's disk."""
    fit_steps: int
    """Optimizer steps of the fit."""
    fit_step_s: float
    """Seconds a step, on the learner."""


@dataclass(frozen=True)
class Rates:
    """Everything that ``plan`` measures, on one machine."""

    run: str
    machine: str
    cores: int
    phases: tuple[PhaseRates, ...]
    ingest_per_s: float
    """Trajectories a second through the learner's inbox, durably."""
    weights_bytes: int
    """Bytes of a version's weights, as a worker receives them."""
    checkpoint_bytes: int
    """Bytes of a version on the learner's disk."""
    start_s: float
    """Seconds until learner and workers are up."""
    evaluate_s: float
    """Seconds of the evaluation at the end, on the learner."""

    def as_dict(self) -> dict[str, Any]:
        return dataclasses.asdict(self)

    @classmethod
    def read(cls, file: Path, run: str) -> Rates:
        """From what ``plan --json`` printed.  Raises ConfigError for another file, or another run's."""
        try:
            given = json.loads(file.read_text().splitlines()[-1])["rates"]
            found = cls(**{**given, "phases": tuple(PhaseRates(**phase) for phase in given["phases"])})
        except (OSError, ValueError, TypeError, KeyError, IndexError) as error:
            raise ConfigError(f"--rates {file}: not what `icrl-dist plan {run} --json` prints ({error})") from None
        if found.run != run:
            raise ConfigError(f"--rates {file}: of {found.run!r}, not of {run!r}; measure them for this run")
        return found


def estimate(rates: Rates, nodes: int, cores: int, gbit_per_s: float) -> dict[str, Any]:
    """Hours, bytes and the first bottleneck with ``nodes`` machines of ``cores`` workers each.

    Their workers are as fast as the one that was measured; the learner's network carries
    ``gbit_per_s``.  Raises ConfigError for a number that is not above 0.
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
    "jobs": "fewer jobs than workers: smaller ones spread better (stream.job_tasks)",
    "ingest": "the learner's inbox: more nodes change nothing, a faster disk and core do",
    "network": "the learner's network: more nodes change nothing",
    "fit": "the learner alone: a GPU or a faster machine for the head, not more nodes",
    "evaluation": "the learner alone, at the end: fewer evaluate.episodes or evaluate.seeds",
    "start": "processes and imports: the run is too short for a cluster",
}
"""Where time goes, and what would change it."""


def _collecting(phase: PhaseRates, rates: Rates, workers: int, gbit_per_s: float) -> dict[str, float]:
    """Seconds that each limit alone would hold the phase up."""
    turns = math.ceil(phase.jobs / workers) * phase.job_s
    return {
        "jobs" if workers > phase.jobs else "collecting": turns,
        "ingest": phase.trajectories / rates.ingest_per_s,
        "network": (phase.trajectories * phase.message_bytes + workers * rates.weights_bytes) * 8 / (gbit_per_s * 1e9),
    }


def _peak(phase: PhaseRates, seconds: float) -> float:
    """Megabits a second that come in while the phase is collected."""
    return phase.trajectories * phase.message_bytes * 8e-6 / max(seconds, 1e-3)


def _labels_per_s(rates: Rates) -> float:
    """Labelled states a second, by one worker, in the phases that label."""
    labelling = [p for p in rates.phases if p.labels]
    return sum(p.labels for p in labelling) / sum(p.jobs * p.job_s for p in labelling) if labelling else 0.0


def describe(plan: Mapping[str, Any]) -> str:
    """The estimate as lines for people."""
    hours = plan["hours"]
    took = f"{hours:.1f} hours" if hours >= 1 else f"{hours * 60:.1f} minutes"
    parts = {name: seconds for name, seconds in plan["seconds"].items() if seconds}
    lines = [f"{plan['run']} with {plan['workers']} workers on {plan['nodes']} nodes: {took}"]
    lines += [f"  {name:<11}{seconds:>10.0f} s  {seconds / hours / 36:>3.0f}%" for name, seconds in parts.items()]
    for row in plan["phases"]:
        lines.append(f"  {row['phase']:<11} collect {row['collect_s']:.0f} s (by {row['limit']}), fit {row['fit_s']:.0f} s")
    lines += [
        f"network  {plan['network_bytes'] / 1e9:.3g} GB, at most {plan['network_peak_mbit_per_s']:.3g} Mbit/s to the learner",
        f"disk     {plan['disk_bytes'] / 1e9:.3g} GB on the head",
        f"rates    a worker {plan['env_steps_per_s']:,.0f} environment steps/s, {plan['labels_per_s']:,.0f} labels/s, "
        f"{plan['bytes_a_trajectory']:,} bytes a trajectory, {plan['ingest_per_s']:,.0f} trajectories/s into the learner",
        f"first bottleneck: {plan['bottleneck']} ({plan['why']})",
        f"at most {plan['useful_workers']} workers have something to do at once",
    ]
    return "\n".join(lines)
