"""``icrl-dist export``."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import tyro
from rich.console import Console

from icrl_dist.cli.exit_codes import OK
from icrl_dist.config.run import ConfigError


@dataclass(frozen=True)
class ExportArguments:
    """Write what a run made in a form for others to use."""

    what: tyro.conf.Positional[Path]
    """A run folder (its newest version), or a checkpoint file."""
    to: Literal["agent"] = "agent"
    """``agent``: weights and manifest in one file for ``load_agent``, without what only training
    needs."""
    out: Path | None = None
    """File to write; agent.npz in the run folder, or beside the checkpoint, if not given."""


def export(arguments: ExportArguments, console: Console) -> int:
    """``icrl-dist export``: an agent without what only training needs."""
    from icrl_dist.agent.in_context_agent import checkpoint_file, is_slim, slim
    from icrl_dist.console.display import Display
    from icrl_dist.results import heldout
    from icrl_dist.storage.files import save_checkpoint

    source = checkpoint_file(arguments.what)
    out = arguments.out or (arguments.what if arguments.what.is_dir() else source.parent) / "agent.npz"
    if out.is_dir():
        raise ConfigError(f"--out {out}: is a folder; name a file, such as {out / 'agent.npz'}")
    if out.exists() and not is_slim(out):
        raise ConfigError(f"--out {out}: exists, and is no agent that was exported; name another file")
    with Display(console) as display:
        save_checkpoint(out, slim(heldout.calibrate(source, display)))
    console.print(f"{out}: {out.stat().st_size / 1000:.0f} kB, for icrl_dist.load_agent", highlight=False, markup=False)
    return OK
