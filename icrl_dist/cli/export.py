"""``icrl-dist export``: a trained agent as one file, or the experts of a run as files of stable-baselines3."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import tyro
from rich.console import Console

from icrl_dist.cli.exit_codes import OK
from icrl_dist.config.run import ConfigError


@dataclass(frozen=True)
class ExportArguments:
    """Write the trained agent of a run to one file for use elsewhere, or its SAC experts to a folder.

    ``icrl-dist export RUN_DIR --to sb3 --out experts`` writes every expert of the run as a file that stable-baselines3's
    ``SAC.load`` opens, and manifest.json with task, adversary and return of each.
    """

    what: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="RUN_DIR")]
    """A run folder, of which the newest version is exported, or a checkpoint file (not with ``--to sb3``)."""
    to: Literal["agent", "sb3"] = "agent"
    """``agent``: weights and manifest in one file for ``icrl_dist.load_agent``, without the state that
    only training needs.  ``sb3``: the SAC experts of a run folder, from the cache of this node."""
    out: Path | None = None
    """File to write; with ``--to sb3`` a folder.  Default: agent.npz in the run folder, or beside the checkpoint file."""


def export(arguments: ExportArguments, console: Console) -> int:
    """Write the agent or the experts.  Returns the exit code.  Raises ConfigError if ``--out`` holds something else."""
    if arguments.to == "sb3":
        return _experts(arguments, console)
    from icrl_dist.agent.loading import checkpoint_file, is_slim, slim
    from icrl_dist.console.display import Display
    from icrl_dist.results import heldout
    from icrl_dist.storage.checkpoint import save_checkpoint

    source = checkpoint_file(arguments.what)
    out = arguments.out or (arguments.what if arguments.what.is_dir() else source.parent) / "agent.npz"
    if out.is_dir():
        raise ConfigError(f"--out {out}: is a folder; name a file, such as {out / 'agent.npz'}")
    if out.exists() and not is_slim(out):
        raise ConfigError(f"--out {out}: exists and is not an exported agent; name another file")
    with Display(console) as display:
        save_checkpoint(out, slim(heldout.calibrate(source, display.report)))
    console.print(f"{out}: {out.stat().st_size / 1000:.0f} kB, for icrl_dist.load_agent", highlight=False, markup=False)
    return OK


def _experts(arguments: ExportArguments, console: Console) -> int:
    from icrl_dist.console.display import Display
    from icrl_dist.results import run_experts

    if arguments.out is None:
        raise ConfigError("export --to sb3: name a folder for the experts, as in --out experts")
    with Display(console) as display:

        def progress(done: int, total: int) -> None:
            event = {"event": "progress", "stage": "evaluate", "phase": "evaluating experts"}
            display.report(event | {"step": done, "steps": total})

        entries = run_experts.export(arguments.what, arguments.out, progress)
    lowest, highest = (of(entry["return"] for entry in entries) for of in (min, max))
    text = f"{arguments.out}: {len(entries)} experts for stable_baselines3.SAC.load, returns from {lowest:g} to {highest:g}"
    console.print(text, highlight=False, markup=False)
    return OK
