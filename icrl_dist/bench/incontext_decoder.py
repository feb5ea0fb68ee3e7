"""The compiled decoder beside torch's: single decisions, whole rollouts, and rounds of ICAA.

Both sides run in this process on one core, alternate, and are measured in CPU time.  Torch's side is what
its users run: ``models.decoder.Decoder`` in inference mode, ``InContextPolicy`` with ``context.decoder =
"torch"``, and the jobs of a run with that decoder.
"""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable, Iterator
from functools import partial
from typing import Any, NamedTuple

import numpy as np
import torch

from icrl_dist.bench.incontext_quality import MODEL, PROBLEM
from icrl_dist.bench.samples import RandomWeights
from icrl_dist.collect.adapt import rollouts
from icrl_dist.config.run import load_run
from icrl_dist.config.sections import ContextConfig, Decoder
from icrl_dist.methods import registry as methods
from icrl_dist.models import decoder as by_torch
from icrl_dist.models.compiled import kinds
from icrl_dist.models.dpt import PretrainedTransformer
from icrl_dist.models.gpt import GPT
from icrl_dist.models.kernel import Kernel
from icrl_dist.models.kernel_decoder import KernelDecoder
from icrl_dist.problems import registry
from icrl_dist.rollout.deployment import InContextPolicy
from icrl_dist.rollout.episode import deploy_online
from icrl_dist.types import NULL, Job, Variation


class Shape(NamedTuple):
    """A decision in so many environments, each with a context of so many transitions."""

    environments: int
    transitions: int
    bound: float
    """Least ``kernel_over_torch``: the time of torch's decision, in units of the kernel's."""


SHAPES = (Shape(1, 100, 15), Shape(20, 100, 4), Shape(20, 1000, 2.5), Shape(512, 100, 2.2), Shape(512, 400, 2.5))
BATCHES = (20, 512)
"""Environments of the rollouts."""
EPISODES = 3
"""Online episodes of a rollout; with 100 steps each its contexts have 0, 100 and 200 transitions."""
ROLLOUT_BOUND = 2.0
"""Least decisions per second of rollouts, in units of torch's."""
ROUNDS_BOUND = 0.6
"""Most time of a job of rounds of ICAA, in units of torch's."""
_SECONDS = 0.02
"""CPU time that is measured at once."""

Report = Callable[[str], None]
Sides = dict[Decoder, list[float]]
"""CPU-seconds by decoder, one number per repetition."""
_BOTH: tuple[Decoder, Decoder] = ("torch", "kernel")


def run(quick: bool = False, report: Report = lambda text: None) -> dict[str, Any]:
    """Measure everything; ``quick`` repeats less.  ``decoder_missed`` names each number that misses its bound.

    Where no kernel was built, ``kernel`` is None and nothing else is measured.
    """
    if not kinds():
        return {"kernel": None, "decoder_missed": []}
    repeats = 5 if quick else 15
    result: dict[str, Any] = {"kernel": kinds()[-1]}
    rows = [_decision(shape, repeats, report) for shape in SHAPES]
    result |= {name: [row[name] for row in rows] for name in rows[0]}
    result["kernel_over_torch_bounds"] = [shape.bound for shape in SHAPES]
    result["decisions_per_s"] = {}
    for batch in BATCHES:
        report(f"rollouts in {batch} environments")
        seconds = rollout(batch, 3 if quick else 7)
        rates = {side: batch * EPISODES * horizon() / statistics.median(found) for side, found in seconds.items()}
        result["decisions_per_s"][str(batch)] = {side: round(rate) for side, rate in rates.items()} | {
            "ratio": round(rates["kernel"] / rates["torch"], 2),
            "bound": ROLLOUT_BOUND,
        }
    report("rounds of ICAA")
    jobs = {side: statistics.median(found) for side, found in rounds(1 if quick else 3).items()}
    result["rounds"] = {f"{side}_s": round(found, 3) for side, found in jobs.items()} | {
        "time_ratio": round(jobs["kernel"] / jobs["torch"], 3),
        "bound": ROUNDS_BOUND,
    }
    return result | {"decoder_missed": missed(result)}


def missed(result: dict[str, Any]) -> list[str]:
    """The numbers of a result that miss their bounds, one line each."""
    lines = [
        f"a decision in {shape.environments} environments after {shape.transitions} transitions: the kernel is {ratio} times "
        f"as fast as torch, below {shape.bound:g}"
        for shape, ratio in zip(SHAPES, result["kernel_over_torch"], strict=True)
        if ratio < shape.bound
    ]
    lines += [
        f"rollouts in {batch} environments: {found['ratio']} times torch's decisions, below {found['bound']:g}"
        for batch, found in result["decisions_per_s"].items()
        if found["ratio"] < found["bound"]
    ]
    found = result["rounds"]
    if found["time_ratio"] > found["bound"]:
        lines.append(f"rounds of ICAA take {found['time_ratio']} of torch's time, above {found['bound']:g}")
    return lines


def describe(result: dict[str, Any]) -> list[str]:
    """The result as lines of a table."""
    if result["kernel"] is None:
        return ["no compiled decoder here (icrl-dist doctor says why): torch decides, and nothing was compared"]
    title = f"decoder, CPU-us on one core, {result['kernel']}"
    rows = [f"{title:<44}{'kernel':>10}{'torch':>10}{'ratio':>8}{'bound':>8}{'reading':>10}"]
    columns = (result[name] for name in ("kernel_us", "torch_us", "kernel_over_torch", "read_us"))
    for shape, kernel, side, ratio, read in zip(SHAPES, *columns, strict=True):
        label = f"a decision, {shape.environments} x {shape.transitions} transitions"
        rows.append(f"{label:<44}{kernel:>10,.1f}{side:>10,.1f}{ratio:>8.2f}{shape.bound:>8g}{read:>10,.1f}")
    for batch, found in result["decisions_per_s"].items():
        label = f"decisions/s in rollouts, {batch} environments"
        rows.append(f"{label:<44}{found['kernel']:>10,}{found['torch']:>10,}{found['ratio']:>8.2f}{found['bound']:>8g}")
    found = result["rounds"]
    label = "seconds of a job of rounds of ICAA"
    ratio, bound = f"{found['time_ratio']:.2f}", f"<={found['bound']:g}"
    rows.append(f"{label:<44}{found['kernel_s']:>10.2f}{found['torch_s']:>10.2f}{ratio:>8}{bound:>8}")
    return rows


def _decision(shape: Shape, repeats: int, report: Report) -> dict[str, float]:
    report(f"a decision in {shape.environments} environments, {shape.transitions} transitions")
    seconds = decision(shape, repeats)
    us = {side: 1e6 * statistics.median(found) for side, found in seconds.items()}
    return {
        "kernel_over_torch": round(us["torch"] / us["kernel"], 2),
        "torch_us": round(us["torch"], 1),
        "kernel_us": round(us["kernel"], 1),
        "read_us": round(1e6 * statistics.median(_reading(shape, repeats)), 1),
    }


def decision(shape: Shape, repeats: int) -> Sides:
    """CPU-seconds of one decision of both decoders: the same weights, contexts and queries."""
    torch.manual_seed(0)
    trunk = GPT(MODEL.layers, MODEL.heads, MODEL.width, 0.0).eval()
    context = torch.randn(shape.environments, shape.transitions, MODEL.width)
    query = torch.randn(shape.environments, MODEL.width)
    weights = {name: value.numpy() for name, value in trunk.state_dict().items()}
    kernel = KernelDecoder(weights, MODEL.heads, shape.environments, Kernel())
    kernel.append(context.numpy())
    with torch.inference_mode():
        side = by_torch.Decoder(trunk, shape.environments)
        side.append(context)
        array = query.numpy()
        return alternately({"torch": lambda: side.query(query), "kernel": lambda: kernel.query(array)}, repeats)


def _reading(shape: Shape, repeats: int) -> list[float]:
    """CPU-seconds of one pass over as many bytes as the contexts have: no decoder that reads them from memory is faster."""
    context = np.ones(MODEL.layers * shape.environments * shape.transitions * MODEL.width, np.float32)
    return [_seconds(lambda: np.dot(context, context)) for _ in range(repeats)]


def rollout(batch: int, repeats: int) -> Sides:
    """CPU-seconds of ``EPISODES`` online episodes in Dark Room with a growing context, by Algorithm 1."""
    part = registry.problem(PROBLEM).benchmarks
    assert part is not None
    env = registry.batch([Variation(row.task, NULL) for row in part.rows(np.random.default_rng(0), batch)])
    torch.manual_seed(0)
    model = PretrainedTransformer(env.spec, MODEL).eval()

    def deploy(decoder: Decoder) -> None:
        policy = InContextPolicy(model, batch, ContextConfig(decoder=decoder))
        rngs = np.random.default_rng(0).spawn(batch)
        for _ in deploy_online(env, policy, [rngs] * EPISODES):
            pass

    return alternately({side: partial(deploy, side) for side in _BOTH}, repeats)


def horizon() -> int:
    """Steps of an episode of the rollouts."""
    part = registry.problem(PROBLEM).benchmarks
    assert part is not None
    return registry.spec(part.rows(np.random.default_rng(0), 1)[0].task).horizon


def rounds(repeats: int) -> Sides:
    """CPU-seconds of a job of a round of ICAA in a 7x7 room: T^j in 8 variations of 10 tasks, 24 trials."""
    return alternately({side: _job(side) for side in _BOTH}, repeats)


def _job(decoder: Decoder) -> Callable[[], None]:
    settings = load_run("darkroom-7x7", "method=icaa", "adversary.count=7", "icaa.trials=23", f"context.decoder={decoder}")
    problem, method = registry.of(settings), methods.of(settings)
    torch.manual_seed(0)
    weights = RandomWeights(method.build(problem.spec, settings).eval())
    job: Job = method.ask(settings, next(phase for phase in method.phases(settings) if phase.stage == "adapt"))[0]

    def work() -> None:
        for _ in rollouts(job, problem, method, weights, "bench"):
            pass

    return work


def alternately(calls: dict[Decoder, Callable[[], object]], repeats: int) -> Sides:
    """CPU-seconds of each call, measured in turn; the first calls, with cold caches, are not counted."""
    times = {side: max(1, round(_SECONDS / max(1e-9, min(_warm(call))))) for side, call in calls.items()}
    found: Sides = {side: [] for side in calls}
    for _ in range(repeats):
        for side, call in calls.items():
            found[side].append(_seconds(call, times[side]))
    return found


def _warm(call: Callable[[], object]) -> Iterator[float]:
    return (_seconds(call) for _ in range(2))


def _seconds(call: Callable[[], object], times: int = 1) -> float:
    """CPU-seconds of a call, as the mean of several in a row."""
    began = time.process_time()
    for _ in range(times):
        call()
    return (time.process_time() - began) / times
