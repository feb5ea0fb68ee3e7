"""``icrl-dist chaos``."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path

import tyro
from rich.console import Console

from icrl_dist.cli.exit_codes import FAILED, OK
from icrl_dist.config.run import ConfigError


@dataclass(frozen=True)
class ChaosArguments:
    """Disturb a small job on a seeded schedule: every digest must equal the undisturbed run's.

    RUN is run once undisturbed, then once for each fault: kill-worker, kill-learner and
    kill-tree (SIGKILL), stop-learner (SIGSTOP for 15 s), cut-link (12 s of silence), torn-tail
    and flip-byte (a damaged dataset), full-disk (needs root, or user namespaces).  A fault that
    did not land, for nothing died, was sent again or was repaired, fails the command as another
    digest does.  ``icrl-dist chaos smoke`` takes some minutes on two cores.
    """

    run: tyro.conf.Positional[str] = "smoke"
    """Name of a packaged run, or path of a run file."""
    set: tyro.conf.UseAppendAction[tuple[str, ...]] = ()
    """SECTION.NAME=VALUE, as in icaa.trials=60; may be given many times."""
    seeds: int = 1
    """Schedules to run: each strikes elsewhere."""
    seed: int = 0
    """The first schedule's seed."""
    faults: str = ""
    """Some of the faults, such as kill-worker,torn-tail; all if not given."""
    actors: int = 2
    """Workers."""
    out: Path = Path("runs/chaos")
    """Where run folders and logs are made; those of faults that changed nothing are removed."""
    reference: Path | None = None
    """Folder of a finished run with the same numbers, to compare with instead of running it."""
    json: bool = False
    """Print one JSON object on the last line."""


def chaos(arguments: ChaosArguments, console: Console) -> int:
    """``icrl-dist chaos``: exit code 1 if a fault did not land or changed a digest."""
    from icrl_dist.chaos.campaign import Campaign
    from icrl_dist.chaos.training import Broken
    from icrl_dist.launch.learner_process import TrainFailed

    given = arguments
    if given.seeds < 1 or given.actors < 1:
        raise ConfigError(f"--seeds {given.seeds} --actors {given.actors}: at least 1 of each is needed")
    seeds = range(given.seed, given.seed + given.seeds)
    with Campaign(given.run, given.set, given.actors, given.out, console) as campaign:
        try:
            answer = campaign.run(given.faults, seeds, given.reference)
        except Broken as error:
            raise TrainFailed(f"undisturbed: {error}") from None
    if given.json:
        print(json.dumps(answer))
    return OK if answer["ok"] else FAILED
