"""``icrl-dist export``: a trained agent as one file."""

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
    """Write the trained agent of a run to one file for use elsewhere."""

    what: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="RUN_DIR")]
    """A run folder, of which the newest version is exported, or a checkpoint file."""
    to: Literal["agent"] = "agent"
    """``agent``: weights and manifest in one file for ``icrl_dist.load_agent``, without the state that
    only training needs."""
    out: Path | None = None
    """File to write.  Default: agent.npz in the run folder, or beside the checkpoint file."""


def export(arguments: ExportArguments, console: Console) -> int:
    """Write the agent.  Returns the exit code.  Raises ConfigError if the file exists and is no exported agent."""
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
