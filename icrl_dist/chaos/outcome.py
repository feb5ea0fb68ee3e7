"""What came of a campaign: an outcome a fault, beside the undisturbed run, as a table and as plain values."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rich.table import Table

from icrl_dist.chaos.disk import allocated
from icrl_dist.config.run import ConfigError, Run, load

SAME = ("dataset_digest", "weights_digest", "trajectories")
"""What must be equal in every result."""


@dataclass(frozen=True)
class Reference:
    """The undisturbed run."""

    result: dict[str, Any]
    room: int
    """Bytes that its folder takes, without what is written after the training."""
    seconds: float

    @classmethod
    def of(cls, folder: Path, run: Run) -> Reference:
        """From the folder of a finished run, however it was evaluated.

        Raises ConfigError if it is none, or one of other numbers.
        """
        try:
            result = json.loads((folder / "result.json").read_text())
        except (OSError, ValueError) as error:
            raise ConfigError(f"--reference {folder}: holds no result of a finished run ({error})") from None
        if dataclasses.replace(load(str(folder / "run.toml")), evaluate=run.evaluate) != run:
            raise ConfigError(f"--reference {folder}: is a run of other numbers; leave it out to run one with these")
        return cls(result, allocated(folder) - allocated(folder / "report"), float(result["seconds"]))

    def equals(self, result: dict[str, Any]) -> bool:
        """Whether another run ended like this one."""
        return all(result[name] == self.result[name] for name in (*SAME, "quarantined"))


@dataclass(frozen=True)
class Outcome:
    """What became of one fault."""

    seed: int
    fault: str
    struck: str
    """How far the run was; where it should have been if the strike found nothing to hit."""
    landed: bool
    evidence: str
    """What shows that it landed, or what went wrong."""
    equal: bool
    """Whether every digest is the undisturbed run's."""
    seconds: float = 0.0
    attempts: int = 1
    folder: str = ""
    """The run folder, kept if not all is as it should be."""

    @property
    def ok(self) -> bool:
        """Whether it landed and changed nothing."""
        return self.landed and self.equal


def table(outcomes: Sequence[Outcome]) -> Table:
    """A row a fault."""
    shown = Table()
    for name in ("seed", "fault", "struck at", "evidence", "s", "landed", "equal"):
        shown.add_column(name, justify="right" if name in ("seed", "s") else "left", no_wrap=name == "fault")
    for o in outcomes:
        evidence = o.evidence + (f" (attempt {o.attempts})" if o.attempts > 1 else "")
        landed, equal = ("yes" if value else "NO" for value in (o.landed, o.equal))
        shown.add_row(str(o.seed), o.fault, o.struck, evidence, f"{o.seconds:.0f}", landed, equal)
    return shown


def verdict(outcomes: Sequence[Outcome]) -> str:
    """One line."""
    bad = [o for o in outcomes if not o.ok]
    if not bad:
        return f"all {len(outcomes)} faults landed, and every digest equals the undisturbed run's"
    return f"{len(bad)} of {len(outcomes)} faults failed: " + "; ".join(
        f"seed {o.seed}, {o.fault}, {'unequal digests' if o.landed else 'it did not land'}: {o.folder}" for o in bad
    )


def summary(outcomes: Sequence[Outcome], reference: Reference, seconds: float) -> dict[str, Any]:
    """Everything as plain values; ``ok`` is the verdict."""
    digests = {name: reference.result[name] for name in SAME}
    rows = [dataclasses.asdict(outcome) for outcome in outcomes]
    return {"ok": bool(outcomes) and all(o.ok for o in outcomes), **digests, "faults": rows, "seconds": round(seconds, 1)}
