"""``icrl-dist bench``."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import tyro
from rich.console import Console

from icrl_dist.cli.exit_codes import FAILED, OK
from icrl_dist.config.run import ConfigError


@dataclass(frozen=True)
class BenchArguments:
    """Measure one part of the system on this machine, beside what it is compared with."""

    name: tyro.conf.Positional[
        Literal[
            "env",
            "stream",
            "ingest",
            "scale",
            "broadcast",
            "recovery",
            "soak",
            "fuzz",
            "incontext",
            "experts",
            "disturbance",
            "monitor",
        ]
    ]
    """``env``: environment steps a second, of simulated problems beside their library's own loop;
    ``stream``: trajectories a second through the stream and, in the same run, as Ray actor returns;
    ``ingest``: trajectories a second onto the disk, with and without fsync; ``scale``: the same from
    1 to 256 simulated workers; ``broadcast``: weights
    to eight processes, beside ``ray.put`` and ``get``; ``recovery``: how soon a run is at work again
    after a worker or the learner was killed; ``soak``: does any process of a long run grow;
    ``fuzz``: 100,000 hostile inputs to every reader of bytes; ``incontext``: deployment and
    training of the model, beside DPT's official layout; ``experts``: updates of experts in
    lockstep, beside stable-baselines3; ``disturbance``: the return that an undisturbed expert loses
    under each default adversary; ``monitor``: what it costs a run to be watched, and a view to watch a
    thousand streams."""
    problem: str | None = None
    """Which environment: one such as ``dmc-cheetah-run`` (env: ``darkroom`` if not given;
    disturbance: every simulated one)."""
    seconds: float | None = None
    """How long to measure (env, stream, ingest, scale and soak)."""
    quick: bool = False
    """One seed instead of three (incontext), 3 turns instead of 15 (experts), experts that have learned
    little and 3 episodes instead of 10 (disturbance), 2 pairs of short windows instead of 8 (monitor)."""
    drop: float | None = None
    """disturbance: instead, the strength at which that share of the return is lost, as in 0.25; solved once
    a problem and kept for ``control.strength`` of later runs, as ``drop:0.25``."""
    steps: int | None = None
    """Steps of the experts' training (disturbance --drop), or those of it with updates (experts --device cuda)."""
    device: Literal["cpu", "cuda", "auto"] = "cpu"
    """experts: ``cuda`` measures 160 experts on a GPU beside stable-baselines3 on one core, and trains an
    expert set of the paper for a while to tell how long it takes; ``auto``: on a GPU if there is one."""
    folder: Path = Path("runs")
    """Whose disk to write to (ingest, scale, recovery), where to put the figure (soak, incontext) or an
    input that breaks something (fuzz), where to keep finished trainings (incontext)."""
    json: bool = False
    """Print one JSON object on the last line."""


def bench(arguments: BenchArguments, console: Console) -> int:
    """``icrl-dist bench``: one benchmark."""
    from icrl_dist.bench import (
        broadcast,
        disturbance,
        drop,
        env,
        experts,
        experts_gpu,
        fuzz,
        incontext,
        ingest,
        monitor,
        recovery,
        scale,
        soak,
        stream,
    )

    if arguments.seconds is not None and arguments.name in (
        "broadcast",
        "disturbance",
        "experts",
        "fuzz",
        "incontext",
        "monitor",
        "recovery",
    ):
        raise ConfigError(f"bench {arguments.name}: --seconds: it takes as long as it takes; leave it out")
    if (arguments.name != "disturbance" or arguments.quick) and arguments.drop is not None:
        raise ConfigError(f"--drop {arguments.drop:g}: it belongs to `bench disturbance`, without --quick")
    if arguments.name != "experts" and arguments.device != "cpu":
        raise ConfigError(f"--device {arguments.device}: it belongs to `bench experts`")
    if arguments.drop is None and arguments.device == "cpu" and arguments.steps is not None:
        raise ConfigError(
            f"--steps {arguments.steps}: it belongs to `bench disturbance --drop` and `bench experts --device cuda`"
        )
    if arguments.device != "cpu" and arguments.steps is not None and arguments.steps < 1:
        raise ConfigError(f"--steps {arguments.steps}: must be above 0")
    timed: dict[str, Any] = {} if arguments.seconds is None else {"seconds": arguments.seconds}
    match arguments.name:
        case "env":
            result, text = (r := env.run(arguments.problem or "darkroom", **timed)), env.describe(r)
        case "stream":
            result, text = (r := stream.run(**timed)), stream.describe(r)
        case "ingest":
            result, text = (r := ingest.run(arguments.folder, **timed)), ingest.describe(r)
        case "scale":
            with console.status("scale"):
                result = scale.run(arguments.folder, **timed)
            text = scale.describe(result)
        case "broadcast":
            result, text = (r := broadcast.run()), broadcast.describe(r)
        case "recovery":
            result, text = (r := recovery.run(arguments.folder)), recovery.describe(r)
        case "soak":
            with console.status("soak") as status:
                show = lambda elapsed, said: status.update(f"soak: {elapsed:.0f} s, {said}")  # noqa: E731
                result = soak.run(folder=arguments.folder, report=show, **timed)
            text = soak.describe(result)
        case "fuzz":
            result, text = (r := fuzz.run(folder=arguments.folder)), fuzz.describe(r)
        case "incontext":
            with console.status("incontext") as status:
                result = incontext.run(arguments.folder, arguments.quick, lambda said: status.update(f"incontext: {said}"))
            text = incontext.describe(result)
        case "experts":
            with console.status("experts"):
                on_gpu = arguments.device == "cuda" or (arguments.device == "auto" and experts_gpu.present())
                result = experts_gpu.run(arguments.quick, arguments.steps) if on_gpu else experts.run(arguments.quick)
            text = (experts_gpu if on_gpu else experts).describe(result)
        case "disturbance":
            say = lambda said: console.print(said, highlight=False, markup=False)  # noqa: E731
            if arguments.drop is None:
                text = disturbance.describe(result := disturbance.run(arguments.problem, arguments.quick, say))
            else:
                text = drop.describe(result := drop.run(arguments.drop, arguments.problem, arguments.steps, say))
        case "monitor":
            with console.status("monitor"):
                result = monitor.run(arguments.folder, *((2, 2.0) if arguments.quick else ()))
            text = monitor.describe(result)
    console.print(text, highlight=False, markup=False)
    if arguments.json:
        print(json.dumps(result))
    return OK if result.get("ok", True) else FAILED
