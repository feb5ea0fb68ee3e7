"""The steps of a fit: by torch, by the way that a run takes, and the time that their matrix products alone would take.

The batches are those that the run draws in the fit of T^0, from the data of its first job.  All ways take the same
steps in turns, with one thread and with the learner's.  Ways are compared by wall time, as a run takes it: medians over
rounds.  Steps and products are compared by CPU time, each in the round that other processes disturbed least.
"""

from __future__ import annotations

import os
import statistics
import time
from collections.abc import Callable, Sequence
from typing import Any

import torch

from icrl_dist.bench import fit_ways
from icrl_dist.bench.fit_floor import step_flops
from icrl_dist.bench.fit_ways import Part, PartsOfTorch, Steps
from icrl_dist.bench.samples import Sample, collected
from icrl_dist.config.run import Run, load_run
from icrl_dist.interfaces import Draw
from icrl_dist.methods import registry as methods

RUNS = ("darkroom-7x7", "darkroom")
FIT_OVER_TORCH = 1.5
"""Least steps of a run per step of torch in the same time."""
STEP_OVER_FLOOR = 2.0
"""Most CPU time of a step, in units of that of its products."""
ROUNDS, STEPS = 40, 2
"""Rounds of all ways in turns, and steps of each way in a round."""
SIZE = 1024
"""Rows and columns of the matrices whose product gives the rate of this machine."""

Report = Callable[[str], None]


def run(quick: bool = False, report: Report = lambda text: None, runs: Sequence[str] = RUNS) -> dict[str, Any]:
    """Measure the fits of these runs; ``quick`` takes 10 rounds instead of 40.

    ``ok`` is false if a bound is missed; ``reasons`` lists which.  Without the compiled kernel there is nothing to compare,
    so no bound holds.
    """
    before = torch.get_num_threads()
    try:
        rows = [row for name in runs for row in _run(name, 10 if quick else ROUNDS, report)]
    finally:
        torch.set_num_threads(before)
    reasons = [reason for row in rows for reason in _missed(row)]
    return {
        "fits": rows,
        "fit_over_torch": [row["fit_over_torch"] for row in rows],
        "step_over_floor": [row["step_over_floor"] for row in rows],
        "ok": not reasons,
        "reasons": reasons,
    }


def _missed(row: dict[str, Any]) -> list[str]:
    """The bounds that a fit misses."""
    missed, where = [], _name(row)
    if len(row["ways"]) == 1:
        return []
    if row["fit_over_torch"] < FIT_OVER_TORCH:
        missed.append(f"{where}: {row['fit_over_torch']:.2f} steps per step of torch, below {FIT_OVER_TORCH:g}")
    if row["step_over_floor"] > STEP_OVER_FLOOR:
        missed.append(f"{where}: a step takes {row['step_over_floor']:.2f} times its floor, above {STEP_OVER_FLOOR:g}")
    return missed


def _run(name: str, rounds: int, report: Report) -> list[dict[str, Any]]:
    """One row for each number of threads."""
    chosen = load_run(name, "learner.device=cpu")
    report(f"{name}: its data")
    method = methods.of(chosen)
    phase = method.phases(chosen)[0]
    draw = method.data(chosen, phase, Sample({phase.stage: collected(chosen, phase, fit_ways.new_model(chosen))}))
    rows = []
    for threads in sorted({1, chosen.learner.threads or len(os.sched_getaffinity(0))}):
        torch.set_num_threads(threads)
        row = {"run": name, "width": chosen.model.width, "threads": threads}
        report(_name(row))
        rows.append(row | _ways(chosen, draw, threads, rounds) | {"parts": _parts(chosen, draw, rounds * STEPS)})
    return rows


def _ways(chosen: Run, draw: Draw, threads: int, rounds: int) -> dict[str, Any]:
    """Rates of all ways; how many steps the last one takes for one of torch; and the floor of a step."""
    ways = {name: make(chosen, draw, threads) for name, make in fit_ways.ways(chosen).items()}
    model = fit_ways.new_model(chosen)
    timed: dict[str, list[Part]] = {name: [] for name in ways}
    flops, dense, product_ms = list[float](), list[float](), list[float]()
    for turn in range(-1, rounds):
        first = (turn + 1) * STEPS
        for name, steps in sorted(ways.items(), reverse=bool(turn % 2)):
            found = _timed(steps, first)
            if turn >= 0:  # the first one warms the caches
                timed[name].append(found)
        if turn >= 0:
            batches = [fit_ways.batch_of(chosen, draw, step) for step in range(first, first + STEPS)]
            flops.append(statistics.mean(step_flops(model, batch) for batch in batches))
            dense.append(statistics.mean(step_flops(model, batch, hidden=True) for batch in batches))
            product_ms += _product_ms()
    flops_per_ms = 2 * SIZE**3 / min(product_ms)

    def over_floor(name: str) -> float:
        return min(part.cpu_ms / count for part, count in zip(timed[name], flops, strict=True)) * flops_per_ms

    default = list(ways)[-1]
    return {
        "ways": {name: _median(found) for name, found in timed.items()},
        "fit_over_torch": statistics.median(a.wall_ms / b.wall_ms for a, b in zip(timed["torch"], timed[default], strict=True)),
        "step_over_floor": over_floor(default),
        "torch_over_floor": over_floor("torch"),
        "gflops": flops_per_ms / 1e6,
        "floor_ms": statistics.mean(flops) / flops_per_ms,
        "dense_floor_ms": statistics.mean(dense) / flops_per_ms,
    }


def _median(found: Sequence[Part]) -> dict[str, float]:
    wall_ms, cpu_ms = (statistics.median(times) for times in zip(*found, strict=True))
    return {"steps_per_s": 1e3 / wall_ms, "cpu_ms": cpu_ms}


def _timed(steps: Steps, first: int) -> Part:
    """Time of a step, its batch included: the mean of ``STEPS`` steps."""
    wall, cpu = time.perf_counter(), time.process_time()
    steps(first, STEPS)
    return Part(1e3 * (time.perf_counter() - wall) / STEPS, 1e3 * (time.process_time() - cpu) / STEPS)


def _product_ms(repeats: int = 2) -> list[float]:
    """CPU time of products of two large float32 matrices, with torch's present number of threads."""
    a, times = torch.ones(SIZE, SIZE), list[float]()
    for _ in range(repeats):
        began = time.process_time()
        a @ a
        times.append(1e3 * (time.process_time() - began))
    return times


def _parts(chosen: Run, draw: Draw, count: int) -> dict[str, dict[str, float]]:
    """Medians of the times of each part of a step by torch."""
    steps = PartsOfTorch(chosen, draw)
    steps.step(0)
    found = [steps.step(number) for number in range(1, count + 1)]
    return {
        name: Part(*map(statistics.median, zip(*(parts[name] for parts in found), strict=True)))._asdict() for name in found[0]
    }


def describe(result: dict[str, Any]) -> str:
    """The result as tables."""
    rows = result["fits"]
    names = list(dict.fromkeys(name for row in rows for name in row["ways"]))
    heads = "".join(f"{name + '/s':>10}{'CPU-ms':>7}" for name in names)
    lines = [f"{'steps':<20}{heads}{'ratio':>6}{'floor':>6}{'over':>6}{'dense':>6}"]
    for row in rows:
        found = [row["ways"].get(name) for name in names]
        rates = "".join(" " * 17 if way is None else f"{way['steps_per_s']:>10.1f}{way['cpu_ms']:>7.1f}" for way in found)
        floors = f"{row['floor_ms']:>6.1f}{row['step_over_floor']:>6.2f}{row['dense_floor_ms']:>6.1f}"
        lines.append(f"{_name(row):<20}{rates}{row['fit_over_torch']:>6.2f}{floors}")
    if all(len(row["ways"]) == 1 for row in rows):
        lines.append("no training kernel here (icrl-dist doctor says why): nothing was compared")
    lines += [
        "/s: steps per second; CPU-ms: CPU time of a step",
        f"ratio: fit_over_torch, steps per second, at least {FIT_OVER_TORCH:g}",
        "floor: CPU-ms of the products of a step at the rate of a large one",
        f"over: step_over_floor, CPU time of a step over it, at most {STEP_OVER_FLOOR:g}",
        "dense: the floor with the pairs of tokens that a mask hides",
        "",
    ]
    parts = list(dict.fromkeys(name for row in rows for name in row["parts"]))
    lines.append(f"{'CPU-ms by torch':<19}" + "".join(f"{name:>{len(name) + 1}}" for name in parts))
    for row in rows:
        times = [(name, row["parts"].get(name)) for name in parts]
        cells = (f"{'' if part is None else format(part['cpu_ms'], '.1f'):>{len(name) + 1}}" for name, part in times)
        lines.append(f"{_name(row):<19}" + "".join(cells))
    return "\n".join([*lines, *result["reasons"]])


def _name(row: dict[str, Any]) -> str:
    """What a row is called in tables: ``darkroom, 2 threads``."""
    return f"{row['run']}, {row['threads']} thread{'s' * (row['threads'] > 1)}"
