"""``icrl-dist bench``: benchmarks of parts of the system."""

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
    """Measure one part of the system on this machine, beside a baseline."""

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
            "fit",
            "first-action",
            "experts",
            "disturbance",
            "ceilings",
            "monitor",
        ]
    ]
    """``env``: environment steps per second, for simulated problems beside their library's own loop.
    ``stream``: trajectories per second through the stream and, in the same run, as Ray actor returns.
    ``ingest``: trajectories per second written to disk, with and without fsync.  ``scale``: the same
    with 1 to 256 simulated workers.  ``broadcast``: weights sent to eight processes, beside ``ray.put``
    and ``ray.get``.  ``recovery``: time until a run continues after a worker or the learner is killed.
    ``soak``: memory growth of every process in a long run.  ``fuzz``: 100,000 hostile inputs to every
    function that decodes bytes.  ``incontext``: deployment and training of the model, beside DPT's
    official layout.  ``fit``: training steps, beside torch's and beside the time of their matrix products alone.
    ``first-action``: time from the start of Python to the first action of an agent, by the compiled decoder and
    by torch.  ``experts``: batched updates of many experts, beside stable-baselines3.
    ``disturbance``: the return that an undisturbed expert loses under each default adversary.
    ``ceilings``: returns of exact agents in Dark Room, by disturbance and strength.
    ``monitor``: cost of the monitor for a run, and of a view that follows a thousand streams."""
    problem: str | None = None
    """Problem to measure, such as ``dmc-cheetah-run`` (default for env: ``darkroom``; for disturbance:
    every simulated problem)."""
    seconds: float | None = None
    """Duration of the measurement (env, stream, ingest, scale and soak)."""
    quick: bool = False
    """Measure less: one seed instead of three (incontext), 10 rounds instead of 40 (fit), 3 repetitions instead of 15
    (experts), briefly trained experts and 3 episodes instead of 10 (disturbance), one split of the goals instead of 4
    (ceilings), 2 pairs of short intervals instead of 8 (monitor)."""
    decisions: bool = False
    """incontext: compare only the compiled decoder with torch's, in about two minutes, and train nothing."""
    drop: float | None = None
    """disturbance: instead, find the strength at which this fraction of the return is lost, such as 0.25.  The
    strength of each problem is kept for later runs with ``control.strength = "drop:0.25"``."""
    steps: int | None = None
    """Training steps of the experts (disturbance --drop), or update steps (experts --device cuda)."""
    device: Literal["cpu", "cuda", "auto"] = "cpu"
    """experts: ``cuda`` measures 160 experts on a GPU beside stable-baselines3 on one core, and trains an
    expert set of the paper for a short time to estimate its full duration.  ``auto``: a GPU if there is one."""
    folder: Path = Path("runs")
    """Folder on the disk to measure (ingest, scale, recovery), for figures (soak, incontext), for inputs
    that cause an error (fuzz), and for finished trainings (incontext)."""
    json: bool = False
    """Print one JSON object on the last line."""


def bench(arguments: BenchArguments, console: Console) -> int:
    """Run one benchmark and print its result.  Returns the exit code."""
    from icrl_dist.bench import (
        broadcast,
        ceilings,
        disturbance,
        drop,
        env,
        experts,
        experts_gpu,
        first_action,
        fit,
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
        "ceilings",
        "disturbance",
        "experts",
        "fit",
        "first-action",
        "fuzz",
        "incontext",
        "monitor",
        "recovery",
    ):
        raise ConfigError(f"bench {arguments.name}: --seconds: this benchmark has a fixed size; leave the option out")
    if (arguments.name != "disturbance" or arguments.quick) and arguments.drop is not None:
        raise ConfigError(f"--drop {arguments.drop:g}: it belongs to `bench disturbance`, without --quick")
    if arguments.name != "incontext" and arguments.decisions:
        raise ConfigError("--decisions: it belongs to `bench incontext`")
    if arguments.name != "experts" and arguments.device != "cpu":
        raise ConfigError(f"--device {arguments.device}: it belongs to `bench experts`")
    if arguments.drop is None and arguments.device == "cpu" and arguments.steps is not None:
        raise ConfigError(
            f"--steps {arguments.steps}: it belongs to `bench disturbance --drop` and `bench experts --device cuda`"
        )
    if arguments.device != "cpu" and arguments.steps is not None and arguments.steps < 1:
        raise ConfigError(f"--steps {arguments.steps}: must be above 0")
    duration: dict[str, Any] = {} if arguments.seconds is None else {"seconds": arguments.seconds}
    match arguments.name:
        case "env":
            result, text = (r := env.run(arguments.problem or "darkroom", **duration)), env.describe(r)
        case "stream":
            result, text = (r := stream.run(**duration)), stream.describe(r)
        case "ingest":
            result, text = (r := ingest.run(arguments.folder, **duration)), ingest.describe(r)
        case "scale":
            with console.status("scale"):
                result = scale.run(arguments.folder, **duration)
            text = scale.describe(result)
        case "broadcast":
            result, text = (r := broadcast.run()), broadcast.describe(r)
        case "recovery":
            result, text = (r := recovery.run(arguments.folder)), recovery.describe(r)
        case "soak":
            with console.status("soak") as status:
                show = lambda elapsed, state: status.update(f"soak: {elapsed:.0f} s, {state}")  # noqa: E731
                result = soak.run(folder=arguments.folder, report=show, **duration)
            text = soak.describe(result)
        case "fuzz":
            result, text = (r := fuzz.run(folder=arguments.folder)), fuzz.describe(r)
        case "incontext":
            with console.status("incontext") as status:
                show_part = lambda part: status.update(f"incontext: {part}")  # noqa: E731
                result = incontext.run(arguments.folder, arguments.quick, show_part, arguments.decisions)
            text = incontext.describe(result)
        case "fit":
            with console.status("fit") as status:
                result = fit.run(arguments.quick, lambda part: status.update(f"fit: {part}"))
            text = fit.describe(result)
        case "first-action":
            with console.status("first-action"):
                result = first_action.run()
            text = first_action.describe(result)
        case "experts":
            with console.status("experts"):
                on_gpu = arguments.device == "cuda" or (arguments.device == "auto" and experts_gpu.present())
                result = experts_gpu.run(arguments.quick, arguments.steps) if on_gpu else experts.run(arguments.quick)
            text = (experts_gpu if on_gpu else experts).describe(result)
        case "disturbance":
            say = lambda text: console.print(text, highlight=False, markup=False)  # noqa: E731
            if arguments.drop is None:
                text = disturbance.describe(result := disturbance.run(arguments.problem, arguments.quick, say))
            else:
                text = drop.describe(result := drop.run(arguments.drop, arguments.problem, arguments.steps, say))
        case "ceilings":
            with console.status("ceilings") as status:
                result = ceilings.run(arguments.quick, lambda part: status.update(f"ceilings: {part}"))
            text = ceilings.describe(result)
        case "monitor":
            with console.status("monitor"):
                result = monitor.run(arguments.folder, *((2, 2.0) if arguments.quick else ()))
            text = monitor.describe(result)
    console.print(text, highlight=False, markup=False)
    if arguments.json:
        print(json.dumps(result))
    return OK if result.get("ok", True) else FAILED
