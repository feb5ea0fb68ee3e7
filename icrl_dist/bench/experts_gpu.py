"""Updates of 160 experts in lockstep on a GPU against stable-baselines3 on one core; and one expert set of the paper.

The GPU is timed by wall clock, synchronized before and after; stable-baselines3 in CPU-seconds of one
thread.  Both alternate.  Drawing the batch from a full replay and the noise is included.
"""

from __future__ import annotations

import contextlib
import statistics
import time
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import torch

from icrl_dist.bench.experts import REPLAY, ExpertSizes, lockstep, single
from icrl_dist.config.run import ConfigError, load
from icrl_dist.config.sac import SACConfig
from icrl_dist.experts.sac.batched import MatmulDtype, SACBatch, pick, train
from icrl_dist.experts.sac.draws import EpisodeDraws
from icrl_dist.interfaces import Batch
from icrl_dist.problems import registry

SIZES = ExpertSizes(160, SACConfig(replay=REPLAY), 60, 12)
LEAST = 300.0
"""Updates per second of all experts, divided by those of stable-baselines3 on one core: a smaller ratio fails."""
PAPER = "dmc-cartpole-balance"
"""The run file whose m x K experts are trained."""
STEPS = 1_500
"""Training steps after the warm-up that are measured."""
_KINDS: dict[str, tuple[MatmulDtype, bool]] = {
    "fp32_no_graph": ("float32", False),
    "bf16_no_graph": ("bfloat16", False),
    "fp32": ("float32", True),
    "bf16": ("bfloat16", True),
}


def present() -> bool:
    """Whether there is a GPU."""
    return torch.cuda.is_available()


def run(quick: bool = False, steps: int | None = None, device: str = "cuda", sizes: ExpertSizes = SIZES) -> dict[str, Any]:
    """Ratios, the gain of CUDA graphs, and the hours of an expert set; ``quick`` takes fewer turns and steps.

    ``ok`` is false if a ratio is below ``LEAST`` or a part could not be measured (its value is then None);
    ``reasons`` lists why.  Raises ConfigError if there is no GPU.
    """
    try:
        torch_device = pick(device)
    except ValueError as error:
        raise ConfigError(f"bench experts: {error}") from None
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        result, reasons = updates(sizes, 3 if quick else 15, torch_device)
        try:
            env, config = paper_env()
            paper = expert_set(env, config, steps or (STEPS // 2 if quick else STEPS), torch_device)
        except (ImportError, RuntimeError) as error:
            paper = None
            reasons.append(f"no expert set: {_first_line(error)}")
    finally:
        torch.set_num_threads(threads)
    name = torch.cuda.get_device_name(torch_device) if torch_device.type == "cuda" else "cpu"
    head = {"quick": quick, "device": name, "torch": torch.__version__, "experts": sizes.experts}
    hours = paper and paper["hours"]
    return head | result | {"paper_set": paper, "paper_set_hours": hours, "ok": not reasons, "reasons": reasons}


def updates(sizes: ExpertSizes, turns: int, device: torch.device) -> tuple[dict[str, Any], list[str]]:
    """Updates/s of all experts, of each kind, and of stable-baselines3 (medians over ``turns``); and reasons for a failure."""
    theirs, their_rates, rates, reasons = single(sizes.config), [], dict.fromkeys(_KINDS, 0.0), []
    theirs(sizes.theirs)  # warms the caches
    for kind, (matmul_dtype, graph) in _KINDS.items():
        try:
            ours, found = lockstep(sizes, matmul_dtype, str(device), graph), []
            _elapsed(ours, sizes.ours, device)  # loads kernels and records the graph
            for _ in range(turns):
                began = time.process_time()
                theirs(sizes.theirs)
                their_rates.append(sizes.theirs / (time.process_time() - began))
                found.append(sizes.experts * sizes.ours / _elapsed(ours, sizes.ours, device))
            rates[kind] = statistics.median(found)
        except RuntimeError as error:  # out of memory, or a graph that cannot be recorded
            reasons.append(f"{kind}: {_first_line(error)}")
    their_rate = statistics.median(their_rates) if their_rates else 0.0
    result: dict[str, Any] = {"sb3_updates_per_s": round(their_rate, 2), "gpu_least": LEAST}
    result |= {f"updates_per_s_{kind}": round(rate, 1) if rate else None for kind, rate in rates.items()}
    for kind in ("fp32", "bf16"):
        rate, no_graph = rates[kind], rates[f"{kind}_no_graph"]
        ratio = result[f"gpu_ratio_{kind}"] = round(rate / their_rate, 1) if rate else None
        result[f"graph_gain_{kind}"] = round(rate / no_graph, 2) if rate and no_graph else None
        if ratio is not None and ratio < LEAST:
            reasons.append(f"gpu_ratio_{kind} is {ratio}, below {LEAST:g}")
    if device.type == "cuda":
        result["gpu_gib"] = round(torch.cuda.max_memory_allocated(device) / 2**30, 2)
    return result, reasons


def paper_env() -> tuple[Batch, SACConfig]:
    """The paper's m = 16 tasks times 10 variations of one problem, and the settings of its SAC."""
    paper = load(PAPER)
    problem = registry.of(paper)
    rows = [row for index, task in enumerate(problem.split.train) for row in registry.training_variations(paper, index, task)]
    return problem.batch(rows), paper.sac


def expert_set(env: Batch, config: SACConfig, steps: int, device: torch.device) -> dict[str, Any]:
    """Train through the warm-up and ``steps`` more (at least three episodes), and project to ``config.steps``.

    ``hours``: the warm-up's steps at their measured rate, and the others at the rate after the first
    episode with updates.  ``ms_a_step``: milliseconds of each part of a step, measured separately, with
    an update divided by the steps between updates; ``bound`` is the largest part.
    """
    began, marks, horizon = time.perf_counter(), [], env.spec.horizon

    def progress(experts: SACBatch, returns: np.ndarray) -> None:
        _synchronize(device)
        marks.append((experts.steps, time.perf_counter()))

    experts = train(env, config, config.warmup + max(steps, 3 * horizon), range(env.batch), progress, str(device))
    warm, warm_end = next(mark for mark in marks if mark[0] >= config.warmup)
    first, first_end = next(mark for mark in marks if mark[0] >= config.warmup + horizon)
    last, last_end = marks[-1]
    warming, learning = (warm_end - began) / warm, (last_end - first_end) / (last - first)
    parts = _parts(env, experts, config, device)
    return {
        "problem": PAPER,
        "experts": experts.experts,
        "steps": experts.steps,
        "updates": experts.updates,
        "steps_per_s": round(1 / learning, 2),
        "warmup_steps_per_s": round(1 / warming, 2),
        "ms_a_step": {part: round(1000 * seconds, 3) for part, seconds in parts.items()},
        "bound": max(parts, key=lambda part: parts[part]),
        "hours": round((warming * config.warmup + learning * (config.steps - config.warmup)) / 3600, 3),
        "hours_of_steps": config.steps,
    }


def _parts(env: Batch, experts: SACBatch, config: SACConfig, device: torch.device) -> dict[str, float]:
    """Seconds per step of each part, in one more episode, with the device synchronized before and after each part."""
    spent = dict.fromkeys(("draw", "environment", "act", "remember", "update"), 0.0)
    count, horizon = -(-env.spec.horizon // config.update_every), env.spec.horizon

    @contextlib.contextmanager
    def timed(part: str) -> Iterator[None]:
        began = time.perf_counter()
        yield
        _synchronize(device)
        spent[part] += time.perf_counter() - began

    with timed("draw"):
        draws = EpisodeDraws(range(env.batch), experts.steps // horizon, env.spec, config, count, device)
    updates = iter(draws.updates)
    observation = np.asarray(env.reset(draws.starts), np.float32)
    for number in range(horizon):
        with timed("act"):
            action = experts.act(observation, draws.normal[number])
        with timed("environment"):
            step = env.step(action)
        with timed("remember"):
            experts.store(observation, action, step)
        if number % config.update_every == 0:
            with timed("update"):
                experts.update_from_replay(*next(updates))
        observation = step.observation
    return {part: seconds / horizon for part, seconds in spent.items()}


def _elapsed(update: Callable[[int], None], count: int, device: torch.device) -> float:
    _synchronize(device)
    began = time.perf_counter()
    update(count)
    _synchronize(device)
    return time.perf_counter() - began


def _synchronize(device: torch.device) -> None:
    if device.type == "cuda":
        torch.cuda.synchronize(device)


def _first_line(error: BaseException) -> str:
    return f"{type(error).__name__}: {str(error).strip().splitlines()[0] if str(error).strip() else ''}"


def describe(result: dict[str, Any]) -> str:
    """The result as a small table."""
    named = {"fp32": "float32", "bf16": "bfloat16 products"}
    title = f"{result['experts']} experts of 3x256, batch 256, {result['device']}"
    rows = [f"{title:<58}{'updates/s':>11}{'no graph':>11}{'over SB3':>10}"]
    for kind, what in named.items():
        figures = (result[name] for name in (f"updates_per_s_{kind}", f"updates_per_s_{kind}_no_graph", f"gpu_ratio_{kind}"))
        with_graph, without, ratio = ("-" if figure is None else f"{figure:,.1f}" for figure in figures)
        rows.append(f"{what:<58}{with_graph:>11}{without:>11}{ratio:>10}")
    rows.append(f"{'stable-baselines3, one expert, one core':<58}{result['sb3_updates_per_s']:>11,.1f}")
    if paper := result["paper_set"]:
        parts = ", ".join(f"{part} {ms:g}" for part, ms in paper["ms_a_step"].items())
        rows.append(
            f"{paper['experts']} experts of {paper['problem']}: {paper['steps_per_s']:g} steps/s (ms per step: {parts})"
        )
        rows.append(f"{paper['hours_of_steps']:,} steps take {paper['hours']:g} h; largest part: {paper['bound']}")
    return "\n".join([*rows, *result["reasons"]])
