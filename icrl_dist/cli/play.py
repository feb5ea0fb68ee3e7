"""``icrl-dist play``: a game against a trained agent, in the browser."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro
from rich.console import Console

from icrl_dist.cli.exit_codes import OK
from icrl_dist.config.run import ConfigError, Deployment


@dataclass(frozen=True)
class PlayArguments:
    """Play the adversary of a trained agent in a Dark Room, live in the browser.

    Move the goal, or override actions by hand or from an action distribution.  The page shows the
    agent's returns beside the oracle's, its OOD score (surprise), and its distribution over goals
    beside the exact posterior.
    """

    what: Annotated[tyro.conf.Positional[Path | None], tyro.conf.arg(metavar="[RUN_DIR]")] = None
    """A run folder, or a checkpoint file."""
    pretrained: str | None = None
    """Instead, the name of an agent that is part of the package: ``darkroom``."""
    web: int = 8000
    """Port of the page; 0 chooses a free port."""
    host: str = "127.0.0.1"
    """Address to listen on.  Everybody who can connect to it can play; the default allows this computer only."""
    deploy: Deployment | None = None
    """Same as for ``icrl-dist evaluate``."""
    seed: int = 0
    """Seed of the agent's and the adversary's draws."""
    paused: bool = False
    """Start paused, so that the same clicks give the same game."""


def play(arguments: PlayArguments, console: Console) -> int:
    """Serve the game until Ctrl-C.  Returns the exit code."""
    from icrl_dist.agent.loading import shipped
    from icrl_dist.monitor import player

    what = arguments.what if arguments.pretrained is None else shipped(arguments.pretrained)
    if what is None or (arguments.what and arguments.pretrained):
        raise ConfigError("play: name a run folder or a checkpoint file, or --pretrained darkroom")
    player.play(what, (arguments.host, arguments.web), arguments.deploy, arguments.seed, arguments.paused, console)
    return OK
