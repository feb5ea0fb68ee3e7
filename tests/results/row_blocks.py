"""Result rows for tests, made from arrays of returns, and printed tables."""

from __future__ import annotations

import io
import json
import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console

from icrl_dist.results import rows


def block(returns: Any, agent: str = "t0", p: float | None = 0.0, seed: int = 0, **others: Any) -> dict[str, Any]:
    """A block of rows of one training.  ``returns``: by task, evaluation seed and episode; ``optimum``: by task."""
    values = np.asarray(returns, float)
    task, evaluation, episode = (index.ravel() for index in np.indices(values.shape))
    optimum = np.asarray(others.pop("optimum", np.full(len(values), np.nan)), float)
    return {
        "run": f"run-{seed}",
        "method": "dpt",
        "problem": "darkroom",
        "training_seed": seed,
        "split_seed": 0,
        "setting": "",
        "variant": "dpt",
        "tasks": "evaluated",
        "agent": agent,
        "policy_version": int(agent[1:]) if agent[1:].isdigit() else -1,
        "weights_digest": f"{agent}-{seed}" if agent[1:].isdigit() else "",
        "ceiling": False,
        "deployment": "paper" if agent[1:].isdigit() else "",
        "data": "",
        "prior": "uniform",
        "task_index": task,
        "task": np.array([json.dumps({"goal": int(i)}) for i in task], object),
        "p": p,
        "adversary_family": "uniform" if p else "null",
        "adversary_index": evaluation,
        "adversary": json.dumps({"p": p} if p else {}),
        "evaluation_seed": evaluation,
        "episode": episode,
        "return": values.ravel(),
        "optimum": optimum[task],
        "diverged": False,
        **others,
    }


def frame(*blocks: Mapping[str, Any], suite: str = "online") -> Any:
    """The blocks, written to a file and read again."""
    with tempfile.TemporaryDirectory() as folder:
        return rows.read([rows.append(Path(folder), suite, {}, blocks)])


def rendered(table: Any) -> str:
    output = io.StringIO()
    Console(file=output, width=250).print(table)
    return output.getvalue()


def unwrapped(text: str) -> str:
    return " ".join(text.split())


def cells_of(text: str) -> tuple[list[str], list[list[str]]]:
    """The cells of the body of a printed table, by row, and its header."""
    header = next(line for line in text.splitlines() if line.startswith("┃"))
    body = [line for line in text.splitlines() if line.startswith("│")]
    return [c.strip() for c in header.strip("┃").split("┃")], [[c.strip() for c in line.strip("│").split("│")] for line in body]
