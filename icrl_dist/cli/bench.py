"""What ``icrl-dist bench`` does with its arguments."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING, Any

from rich.console import Console

from icrl_dist.cli.commands import FAILED, OK
from icrl_dist.config.run import ConfigError

if TYPE_CHECKING:
    from icrl_dist.cli.arguments import Bench


def bench(arguments: Bench, console: Console) -> int:
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
