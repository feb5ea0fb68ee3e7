"""The origin of a training example: its row in the ledger, compared with the stored bytes and weights."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from torch import nn

from icrl_dist.agent.loading import open_checkpoint, trained
from icrl_dist.collect import kinds
from icrl_dist.config.run import ConfigError, Run, load_folder
from icrl_dist.methods import registry as methods
from icrl_dist.problems import registry as problems
from icrl_dist.storage import layout
from icrl_dist.storage.checkpoint import newest_version
from icrl_dist.storage.dataset import Dataset, segments
from icrl_dist.storage.files import StoreError, held
from icrl_dist.storage.fork import Lineage
from icrl_dist.storage.held import opened
from icrl_dist.storage.index import Row
from icrl_dist.stream import wire
from icrl_dist.telemetry import provenance
from icrl_dist.types import Adversary, Identity, Task


def explain(folder: Path, identity: Identity, rerun: bool = False) -> dict[str, Any]:
    """The origin of one trajectory of a run; ``rerun`` repeats its job and compares the bytes.

    Raises ConfigError if the run has no such trajectory, StoreError if a file of it is damaged.
    """
    store, lineage = _open(folder)
    try:
        row = store.index[identity]
        trajectory = store.read(identity)
    except KeyError:
        if lost := damage(folder):
            raise StoreError(f"{folder}: has no trajectory {identity}; {len(lost)} damages, first: {lost[0]}") from None
        raise ConfigError(f"{folder}: has no trajectory {identity}; `icrl-dist explain {folder}` lists all of them") from None
    finally:
        store.close()
    version = identity.next_version  # the first one that is fitted to this trajectory
    seed = lineage.run_of(version).seed
    answer: dict[str, Any] = {
        **ledger_line(row, seed),
        "task": _describe(trajectory.variation.task),
        "adversary": _describe(trajectory.variation.adversary),
        "episode_return": trajectory.episode_return,
        "steps": len(trajectory.actions),
        "labels": len(trajectory.labels),
        "learned_by": [f"T^{later}" for later in range(version, newest_version(folder) + 1)],
        "from_ancestor": version <= max((newest for newest, _ in lineage.ancestors), default=-1),
        "intact": wire.trajectory_digest(trajectory) == row.sha256,
        "sessions": provenance.sessions(folder),
    }
    if row.policy_version >= 0:
        manifest = open_checkpoint(folder, row.policy_version).manifest
        answer["weights_intact"] = manifest["weights_digest"] == row.weights_digest
    if rerun:
        answer["rerun_equal"] = _repeat(folder, lineage.run_of(version), row) == row.sha256
    return answer


def ledger(folder: Path) -> Iterator[dict[str, Any]]:
    """The ledger as dictionaries, one per trajectory of a run, in canonical order."""
    store, lineage = _open(folder)
    try:
        for row in store.index:
            yield ledger_line(row, lineage.run_of(row.identity.next_version).seed)
    finally:
        store.close()


def damage(folder: Path) -> list[str]:
    """Every damaged or missing file of a run folder, a line each; ``icrl-dist train --resume`` mends what it can.

    While a learner is active, what it has not finished is no damage.
    """
    store, lineage = _open(folder)
    active, newest, found = held(folder), newest_version(folder), list[str]()
    lines = [line for line in store.damage if not (active and "torn tail" in line)]
    intact: dict[int, Mapping[str, Any]] = {}
    for version in range(newest + 1):
        try:
            intact[version] = opened(folder, version, lineage).manifest
        except StoreError as error:
            found.append(str(error))
    version = max(intact, default=-1)
    fitted = intact.get(version, {})
    quarantined = {tuple(name.split("/")) for name in fitted.get("quarantined", {})}
    for stage, *numbers in quarantined:
        round_, task, variation = map(int, numbers)
        store.index.drop((stage, round_, task, variation))
    if not active and store.digest(version) != fitted.get("dataset_digest", store.digest(version)):
        known = {path.name for path in segments(store.folder).values()}
        missing = [one["segment"] for one in fitted.get("dataset", ()) if one["segment"] not in known]
        lines += [f"{name}: is missing" for name in missing if f"{name}: is missing" not in lines]
        lines.append(f"its trajectories are not those that T^{version} was fitted to: some are missing or of another run")
    store.close()
    if (folder / provenance.FILE).exists() and not provenance.readable(folder):
        found.append(f"{folder / provenance.FILE}: damaged, it is no list of sessions")
    return [f"{store.folder}/{line}" if line.startswith("segment") else f"{store.folder}: {line}" for line in lines] + found


def ledger_line(row: Row, seed: int) -> dict[str, Any]:
    """A row of the ledger as values for JSON."""
    return {
        "identity": str(row.identity),
        "seed": seed,
        "spawn_key": list(row.identity.key()),
        "policy_version": row.policy_version,
        "weights_digest": row.weights_digest,
        "worker": row.worker,
        "label_origin": "self" if row.origin == "none" else row.origin,
        "sha256": row.sha256,
        "segment": row.segment,
        "byte": row.offset,
        "bytes": row.length,
    }


def describe(answer: dict[str, Any]) -> str:
    """The answer of ``explain`` as text, one fact per line."""
    policy = (
        f"T^{answer['policy_version']} ({answer['weights_digest'][:16]})"
        if answer["policy_version"] >= 0
        else "a policy without weights"
    )
    if "weights_intact" in answer:
        policy += ", equal to its checkpoint" if answer["weights_intact"] else ", whose checkpoint has DIFFERENT weights"
    origin = {"self": "later trials of its own variation (Algorithm 3, line 14)", "optimal": "the variation's optimal policy"}
    facts = {
        "trajectory": answer["identity"] + (" (from the run that this one was forked from)" if answer["from_ancestor"] else ""),
        "task": answer["task"],
        "adversary": answer["adversary"],
        "policy": policy,
        "seed": f"SeedSequence({answer['seed']}, spawn_key={tuple(answer['spawn_key'])})",
        "collected by": f"worker {answer['worker']}",
        "return": f"{answer['episode_return']:g} in {answer['steps']} steps",
        "labels": f"{answer['labels']} in the trajectory, " if answer["labels"] else "",
        "trained": ", ".join(answer["learned_by"]) or "no version yet",
        "stored": f"segment {answer['segment']}, byte {answer['byte']}, {answer['bytes']} bytes",
        "sha256": answer["sha256"] + (" (intact)" if answer["intact"] else " (CHANGED)"),
    }
    if (sessions := answer["sessions"]) and not answer["from_ancestor"]:
        facts["run by"] = provenance.text(sessions[0])
        changed = dict.fromkeys(provenance.differences(sessions[0], later) for later in sessions[1:])
        facts["run by"] += "".join(f"; continued with other software or hardware: {text}" for text in changed if text)
    facts["labels"] += f"from {origin.get(answer['label_origin'], answer['label_origin'])}"
    if "rerun_equal" in answer:
        facts["rerun"] = "the same bytes" if answer["rerun_equal"] else "DIFFERENT bytes: another machine or other versions?"
    return "\n".join(f"{name:<12} {fact}" for name, fact in facts.items())


def _open(folder: Path) -> tuple[Dataset, Lineage]:
    if not (folder / "run.toml").is_file():
        raise ConfigError(f"{folder}: no such run folder")
    layout.refuse_odd_files(folder)
    run = load_folder(folder)
    return Dataset(folder / "dataset", readonly=True), Lineage.of(folder, run)


def _describe(part: Task | Adversary) -> str:
    return f"{part.kind} " + ", ".join(f"{name}={value}" for name, value in part.params)


@dataclasses.dataclass(frozen=True)
class _Checkpoints:
    """The weights of a run folder, for a job that is repeated."""

    folder: Path

    def at(self, version: int) -> tuple[nn.Module, str]:
        checkpoint = open_checkpoint(self.folder, version)
        return trained(checkpoint).model, str(checkpoint.manifest["weights_digest"])


def _repeat(folder: Path, run: Run, row: Row) -> str:
    """Repeat the job of a trajectory in this process.  Returns the trajectory's new digest."""
    method, problem = methods.of(run), problems.of(run)
    for phase in method.phases(run):
        for job in method.ask(run, phase) if (phase.stage, phase.round) == row.identity[:2] else ():
            if (row.identity.task, row.identity.variation) in job.rows():
                repeated = dataclasses.replace(job, policy_version=row.policy_version)
                for trajectory in kinds.do(repeated, problem, method, _Checkpoints(folder), "explain"):
                    if trajectory.identity == row.identity:
                        return wire.trajectory_digest(trajectory)
    raise ConfigError(f"{row.identity}: the settings of the run request no such trajectory; was run.toml changed?")
