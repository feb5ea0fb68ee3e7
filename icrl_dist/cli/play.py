"""``icrl-dist play``."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import tyro
from rich.console import Console

from icrl_dist.cli.exit_codes import OK
from icrl_dist.config.run import ConfigError, Deployment


@dataclass(frozen=True)
class PlayArguments:
    """Be the adversary of a trained agent in a Dark Room, live in the browser.

    Move the goal, override actions by hand or by a law, and watch it adapt: its returns beside the
    oracle's, its surprise, and what it believes of the goal beside the exact posterior.
    """

    what: tyro.conf.Positional[Path | None] = None
    """A run folder, or a checkpoint file."""
    pretrained: str | None = None
    """Instead, the name of an agent that comes with the package: ``darkroom``."""
    web: int = 8000
    """Port of the page; 0 takes a free one."""
    host: str = "127.0.0.1"
    """Address to listen on.  Whoever reaches another than this machine's own may play."""
    deploy: Deployment | None = None
    """As for ``evaluate``."""
    seed: int = 0
    """Of the agent's and the adversary's draws."""
    paused: bool = False
    """Begin paused, so that the same clicks give the same game."""


def play(arguments: PlayArguments, console: Console) -> int:
    """``icrl-dist play``: until Ctrl-C."""
    from icrl_dist.agent.in_context_agent import shipped
    from icrl_dist.monitor import player

    what = arguments.what if arguments.pretrained is None else shipped(arguments.pretrained)
    if what is None or (arguments.what and arguments.pretrained):
        raise ConfigError("play: name a run folder or a checkpoint file, or --pretrained darkroom")
    player.play(what, (arguments.host, arguments.web), arguments.deploy, arguments.seed, arguments.paused, console)
    return OK
