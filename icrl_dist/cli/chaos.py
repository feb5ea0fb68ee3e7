"""``icrl-dist chaos``: deliberate faults in a small run."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro
from rich.console import Console

from actors.placement import local_actors
from icrl_dist.cli.exit_codes import FAILED, OK
from icrl_dist.config.run import ConfigError


@dataclass(frozen=True)
class ChaosArguments:
    """Inject faults into a small run on a seeded schedule: every digest must equal the undisturbed run's.

    RUN is run once undisturbed, then once with each fault: kill-worker, kill-learner and
    kill-tree (SIGKILL), stop-learner (SIGSTOP for 15 s), cut-link (no traffic for 12 s), torn-tail
    and flip-byte (a damaged dataset), full-disk (needs root, or user namespaces), strangers (a flood of
    connections to the learner's port), stop-run (SIGSTOP of the command and of Ray), kill-raylet and
    kill-gcs (SIGKILL of Ray's own processes), hang-up and kill-run (SIGHUP and SIGKILL of the command),
    flip-checkpoint (a damaged checkpoint).  The command
    fails if a digest differs, and also if a fault had no effect: no process died, nothing was sent
    again, nothing was repaired.  ``icrl-dist chaos smoke`` takes some minutes on two cores.
    """

    run: Annotated[tyro.conf.Positional[str], tyro.conf.arg(metavar="[RUN]")] = "smoke"
    """Name of a packaged run, or path of a run file."""
    set: tyro.conf.UseAppendAction[tuple[str, ...]] = ()
    """SECTION.NAME=VALUE, such as icaa.trials=60.  Can be repeated."""
    seeds: int = 1
    """Number of schedules; each places the faults at other moments."""
    seed: int = 0
    """Seed of the first schedule."""
    faults: str = ""
    """Faults to inject, such as kill-worker,torn-tail.  Default: all."""
    actors: int | None = None
    """Number of workers.  Default: 2, or 1 on a single core."""
    out: Path = Path("runs/chaos")
    """Folder for run folders and logs.  Those of passed faults are removed."""
    reference: Path | None = None
    """Folder of a finished run with the same settings, used in place of the undisturbed run."""
    json: bool = False
    """Print one JSON object on the last line."""


def chaos(arguments: ChaosArguments, console: Console) -> int:
    """Run the campaign.  Returns FAILED if a fault had no effect or changed a digest, else OK."""
    from icrl_dist.chaos.campaign import Campaign
    from icrl_dist.chaos.training import TrainingFailed
    from icrl_dist.launch.learner_process import TrainFailed

    actors = local_actors() if arguments.actors is None else arguments.actors
    if arguments.seeds < 1 or actors < 1:
        raise ConfigError(f"--seeds {arguments.seeds} --actors {actors}: at least 1 of each is needed")
    seeds = range(arguments.seed, arguments.seed + arguments.seeds)
    with Campaign(arguments.run, arguments.set, actors, arguments.out, console) as campaign:
        try:
            answer = campaign.run(arguments.faults, seeds, arguments.reference)
        except TrainingFailed as error:
            raise TrainFailed(f"undisturbed: {error}") from None
    if arguments.json:
        print(json.dumps(answer))
    return OK if answer["ok"] else FAILED
