"""The results of a campaign: the undisturbed run and an outcome a fault, as a table and as JSON values."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rich.table import Table

from icrl_dist.chaos.disk import allocated
from icrl_dist.config.run import ConfigError, Run, load_folder
from icrl_dist.launch.auto import without_auto

SAME = ("dataset_digest", "weights_digest", "trajectories")
"""Fields of ``result.json`` that must be equal in every run."""


@dataclass(frozen=True)
class ReferenceRun:
    """The undisturbed run."""

    result: dict[str, Any]
    disk_bytes: int
    """Bytes that its folder occupies, without reports and result rows."""
    seconds: float

    @classmethod
    def of(cls, folder: Path, run: Run) -> ReferenceRun:
        """Read the folder of a finished run; its evaluation settings may differ from ``run``'s.

        ``auto`` is what a run that begins here has.  Raises ConfigError if the folder holds no finished run, or one with
        other settings.
        """
        try:
            result = json.loads((folder / "result.json").read_text())
        except (OSError, ValueError) as error:
            raise ConfigError(f"--reference {folder}: holds no result of a finished run ({error})") from None
        wanted = without_auto(run, folder, resume=False)
        if dataclasses.replace(load_folder(folder), evaluate=run.evaluate) != wanted:
            raise ConfigError(f"--reference {folder}: is a run with other settings; omit --reference to run one with these")
        return cls(
            result, allocated(folder) - allocated(folder / "report") - allocated(folder / "results"), float(result["seconds"])
        )

    def equals(self, result: dict[str, Any]) -> bool:
        """Whether another run's result equals this one's."""
        return all(result[name] == self.result[name] for name in (*SAME, "quarantined"))


@dataclass(frozen=True)
class Outcome:
    """The outcome of one fault."""

    seed: int
    fault: str
    struck: str
    """How far the run was; the planned point if the strike found nothing to hit."""
    landed: bool
    evidence: str
    """The evidence that it landed, or the error."""
    equal: bool
    """Whether every digest equals the undisturbed run's."""
    seconds: float = 0.0
    attempts: int = 1
    folder: str = ""
    """The run folder, kept only if the fault failed."""

    @property
    def ok(self) -> bool:
        """Whether the fault landed and changed no digest."""
        return self.landed and self.equal


def table(outcomes: Sequence[Outcome]) -> Table:
    """A table with a row for each fault."""
    shown = Table()
    for name in ("seed", "fault", "struck at", "evidence", "s", "landed", "equal"):
        shown.add_column(name, justify="right" if name in ("seed", "s") else "left", no_wrap=name == "fault")
    for o in outcomes:
        evidence = o.evidence + (f" (attempt {o.attempts})" if o.attempts > 1 else "")
        landed, equal = ("yes" if value else "NO" for value in (o.landed, o.equal))
        shown.add_row(str(o.seed), o.fault, o.struck, evidence, f"{o.seconds:.0f}", landed, equal)
    return shown


def verdict(outcomes: Sequence[Outcome]) -> str:
    """The verdict in one line."""
    failed = [o for o in outcomes if not o.ok]
    if not failed:
        return f"all {len(outcomes)} faults landed, and every digest equals the undisturbed run's"
    return f"{len(failed)} of {len(outcomes)} faults failed: " + "; ".join(
        f"seed {o.seed}, {o.fault}, {'unequal digests' if o.landed else 'it did not land'}: {o.folder}" for o in failed
    )


def summary(outcomes: Sequence[Outcome], reference: ReferenceRun, seconds: float) -> dict[str, Any]:
    """All results as JSON values; ``ok`` is the verdict."""
    digests = {name: reference.result[name] for name in SAME}
    rows = [dataclasses.asdict(outcome) for outcome in outcomes]
    return {"ok": bool(outcomes) and all(o.ok for o in outcomes), **digests, "faults": rows, "seconds": round(seconds, 1)}
