"""Where a training example came from: the ledger's row, checked against everything that is left of it."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from icrl_dist.agent.in_context_agent import checkpoint_file, model_of
from icrl_dist.collect import jobs
from icrl_dist.config.run import ConfigError, Run, load
from icrl_dist.methods.recipes import METHODS
from icrl_dist.models.dpt import PretrainedTransformer
from icrl_dist.storage.checkpoint import load_checkpoint, newest_version
from icrl_dist.storage.dataset import Dataset
from icrl_dist.storage.fork import Lineage
from icrl_dist.storage.index import Row
from icrl_dist.stream import wire
from icrl_dist.types import Adversary, Identity, Task


def explain(folder: Path, identity: Identity, rerun: bool = False) -> dict[str, Any]:
    """All that is known of one trajectory of a run; ``rerun`` makes it once more and compares the bytes.

    Raises ConfigError if the run has no such trajectory, Damaged if its bytes changed.
    """
    store, lineage = _opened(folder)
    try:
        row = store.index[identity]
        trajectory = store.read(identity)
    except KeyError:
        raise ConfigError(f"{folder}: has no trajectory {identity}; `icrl-dist explain {folder}` lists what it has") from None
    finally:
        store.close()
    produced = identity.next_version
    seed = lineage.run_of(produced).seed
    answer: dict[str, Any] = {
        **ledger_line(row, seed),
        "task": _named(trajectory.variation.task),
        "adversary": _named(trajectory.variation.adversary),
        "episode_return": trajectory.episode_return,
        "steps": len(trajectory.actions),
        "labels": len(trajectory.labels),
        "learned_by": [f"T^{version}" for version in range(produced, newest_version(folder) + 1)],
        "from_ancestor": produced <= max((newest for newest, _ in lineage.ancestors), default=-1),
        "intact": wire.trajectory_digest(trajectory) == row.sha256,
    }
    if row.policy_version >= 0:
        manifest = load_checkpoint(checkpoint_file(folder, row.policy_version)).manifest
        answer["weights_intact"] = manifest["weights_digest"] == row.weights_digest
    if rerun:
        answer["rerun_equal"] = _again(folder, lineage.run_of(produced), row) == row.sha256
    return answer


def ledger(folder: Path) -> Iterator[dict[str, Any]]:
    """A line for every trajectory of a run, in canonical order."""
    store, lineage = _opened(folder)
    try:
        for row in store.index:
            yield ledger_line(row, lineage.run_of(row.identity.next_version).seed)
    finally:
        store.close()


def ledger_line(row: Row, seed: int) -> dict[str, Any]:
    """A row of the ledger as plain values."""
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
    """The answer for people, a line a fact."""
    acted = (
        f"T^{answer['policy_version']} ({answer['weights_digest'][:16]})"
        if answer["policy_version"] >= 0
        else "a policy without weights"
    )
    if "weights_intact" in answer:
        acted += ", whose checkpoint is there" if answer["weights_intact"] else ", whose checkpoint holds OTHER weights"
    origin = {"self": "later trials of its own variation (Algorithm 3, line 14)", "optimal": "the variation's optimal policy"}
    facts = {
        "trajectory": answer["identity"] + (" (of the run that this one was forked from)" if answer["from_ancestor"] else ""),
        "task": answer["task"],
        "adversary": answer["adversary"],
        "acted": acted,
        "seed": f"SeedSequence({answer['seed']}, spawn_key={tuple(answer['spawn_key'])})",
        "made by": f"worker {answer['worker']}",
        "return": f"{answer['episode_return']:g} in {answer['steps']} steps",
        "labels": f"{answer['labels']} of its own, " if answer["labels"] else "",
        "learned by": ", ".join(answer["learned_by"]) or "nothing yet",
        "stored": f"segment {answer['segment']}, byte {answer['byte']}, {answer['bytes']} bytes",
        "sha256": answer["sha256"] + (" (intact)" if answer["intact"] else " (CHANGED)"),
    }
    facts["labels"] += f"from {origin.get(answer['label_origin'], answer['label_origin'])}"
    if "rerun_equal" in answer:
        facts["made again"] = "the same bytes" if answer["rerun_equal"] else "OTHER bytes: another machine, or other versions?"
    return "\n".join(f"{name:<11} {fact}" for name, fact in facts.items())


def _opened(folder: Path) -> tuple[Dataset, Lineage]:
    if not (folder / "run.toml").is_file():
        raise ConfigError(f"{folder}: no such run folder")
    run = load(str(folder / "run.toml"))
    return Dataset(folder / "dataset", readonly=True), Lineage.of(folder, run)


def _named(named: Task | Adversary) -> str:
    return f"{named.kind} " + ", ".join(f"{name}={value}" for name, value in named.params)


@dataclasses.dataclass(frozen=True)
class _Checkpoints:
    """The versions of a run folder, for a job that is done again."""

    folder: Path

    def at(self, version: int) -> tuple[PretrainedTransformer, str]:
        checkpoint = load_checkpoint(checkpoint_file(self.folder, version))
        return model_of(checkpoint)[0], str(checkpoint.manifest["weights_digest"])


def _again(folder: Path, run: Run, row: Row) -> str:
    """The digest of the trajectory, from its job done once more in this process."""
    method = METHODS[run.method]
    for phase in method.phases(run):
        for job in method.ask(run, phase) if (phase.stage, phase.round) == row.identity[:2] else ():
            if (row.identity.task, row.identity.variation) in job.rows():
                repeated = dataclasses.replace(job, policy_version=row.policy_version)
                for trajectory in jobs.do(repeated, _Checkpoints(folder), "explain"):
                    if trajectory.identity == row.identity:
                        return wire.trajectory_digest(trajectory)
    raise ConfigError(f"{row.identity}: the run's present numbers ask for no such trajectory")
