"""A run folder's agents on held-out tasks: who is compared, and what is kept of it."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from rich.console import Console

from icrl_dist import evaluate, plots
from icrl_dist.agent import checkpoint_file, model_of
from icrl_dist.config import Run
from icrl_dist.files import atomic_write, load_checkpoint
from icrl_dist.models.dpt import PretrainedTransformer
from icrl_dist.terminal import Display, returns_table


def models(what: Path) -> dict[str, PretrainedTransformer]:
    """The newest model and, in a run folder, the T^0 that it grew from."""
    newest = load_checkpoint(checkpoint_file(what))
    version = newest.manifest["version"]
    found = {f"T^{version} ({newest.manifest['method']})": model_of(newest)[0]}
    if what.is_dir() and version > 0:
        found["T^0"] = model_of(load_checkpoint(checkpoint_file(what, 0)))[0]
    return found


def online(run: Run, what: Path, display: Display) -> list[evaluate.Result]:
    """Online returns of the folder's models, a random policy and the oracle."""
    agents: dict[str, evaluate.MakePolicy] = {name: evaluate.in_context(run, model) for name, model in models(what).items()}
    agents |= {"random": evaluate.random, evaluate.ORACLE: evaluate.optimal(run)}
    total = len(agents) * len(run.evaluate.p) * run.evaluate.episodes
    done = 0

    def progress(agent: str, p: float, episodes: int) -> None:
        nonlocal done
        done += 1
        display.report({"event": "progress", "stage": "evaluate", "phase": "held-out evaluation", "step": done, "steps": total})

    return evaluate.online(run, agents, progress)


def offline(run: Run, what: Path) -> list[evaluate.Result]:
    """Offline returns of the folder's models, given random and expert data."""
    return evaluate.offline(run, models(what))


def show_online(run: Run, what: Path, results: list[evaluate.Result], console: Console) -> dict[str, Any]:
    """Print the table, draw the figure, keep the rows under ``report/``; returns them with the figure's path."""
    rows = [result.row() for result in results]
    folder = (what if what.is_dir() else what.parent) / "report"
    size, count = run.darkroom.size, len(results[0].optimum)
    title = f"{run.method.upper()} on {count} held-out goals of a {size}x{size} Dark Room, {run.evaluate.seeds} seeds"
    atomic_write(folder / "online.json", lambda file: file.write(json.dumps(rows, indent=1).encode()))
    figure = plots.adaptation(rows, folder / "adaptation.png", title)
    console.print(returns_table(results, f"Return by online episode: {title}"))
    console.print(f"figure {figure}", highlight=False, markup=False)
    return {"rows": rows, "figure": str(figure)}


def show_offline(results: list[evaluate.Result], console: Console) -> dict[str, Any]:
    """Print the table; returns the rows."""
    console.print(returns_table(results, "One episode given data collected before, on goals never trained on"))
    return {"rows": [result.row() for result in results]}
