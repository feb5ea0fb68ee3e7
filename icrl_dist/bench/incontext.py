"""In-context learning against the official DPT layout: deployment, time to quality, labels, long contexts; and both decoders.

Both run in this process on one core and are measured in CPU-seconds.  The peer is a new implementation
(``peer.py``); if it is slower than the official code was, the benchmark fails.
"""

from __future__ import annotations

import json
import statistics
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path
from typing import Any

import torch

from icrl_dist.bench import incontext_cost as cost
from icrl_dist.bench import incontext_decoder as decoder
from icrl_dist.bench import incontext_quality as quality
from icrl_dist.bench import peer
from icrl_dist.models.compiled import kinds
from icrl_dist.storage.files import write_json

FLOORS = {"training": 600.0, "deployment": 1100.0}
"""Contexts, and environment steps in 20 environments, per CPU-second of the official code."""
REFERENCE_GFLOPS = 90.0
"""Float32 matrix products on the machine of these floors; on a slower machine the floors are scaled down."""

Report = Callable[[str], None]


def run(
    folder: Path = Path("runs"), quick: bool = False, report: Report = lambda text: None, decisions: bool = False
) -> dict[str, Any]:
    """Measure everything; ``quick`` takes one seed and fewer repeats, ``decisions`` compares only the decoders.

    Writes ``incontext.png`` and ``incontext.json`` to ``folder``.  The JSON file stores each finished
    training, so an interrupted benchmark continues with the next one.  ``ok`` is false if the peer is
    below its floors, if a training of ours did not reach the target loss, or if the compiled decoder
    misses a bound of ``incontext_decoder``; ``reasons`` lists why.
    """
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        if decisions:
            compared = decoder.run(quick, report)
            return compared | {"quick": quick, "ok": not compared["decoder_missed"], "reasons": compared["decoder_missed"]}
        return _run(folder, quick, report)
    finally:
        torch.set_num_threads(threads)


def _run(folder: Path, quick: bool, report: Report) -> dict[str, Any]:
    report("calibration")
    gflops = cost.matmul_gflops()
    scale = min(1.0, gflops / REFERENCE_GFLOPS)
    result: dict[str, Any] = {"quick": quick, "calibration_gflops": round(gflops, 1), "floor_scale": round(scale, 3)}
    for batch, pairs in ((20, 5 if quick else 11), (512, 1 if quick else 3)):
        report(f"deployment in {batch} environments")
        rates = {side: statistics.median(found) for side, found in cost.deployment(batch, pairs).items()}
        result[f"steps_per_s_{batch}"], result[f"peer_steps_per_s_{batch}"] = round(rates["ours"]), round(rates["peer"])
        result[f"deploy_ratio_{batch}"] = round(rates["ours"] / rates["peer"], 1)
    result |= decoder.run(quick, report)
    report("training steps")
    result |= {name: round(rate) for name, rate in cost.training(3 if quick else 9).items()}
    result["labels_ratio"] = round(result["labels_per_s"] / result["peer_labels_per_s"], 1)
    report("long contexts")
    result |= cost.by_length()
    result["gpu"] = cost.on_device("cuda") if torch.cuda.is_available() else None
    trainings = _trainings(folder / "incontext.json", range(1 if quick else 3), report)
    result |= _time_to_quality(trainings)
    reasons = [
        f"the peer's {name} is {found}/s, below {FLOORS[name] * scale:.0f}: it is slower than the official code"
        for name, found in (("training", result["peer_labels_per_s"]), ("deployment", result["peer_steps_per_s_20"]))
        if found < FLOORS[name] * scale
    ]
    if not all(training["reached"] for name, training in trainings.items() if name.startswith("ours")):
        reasons.append(f"a model of ours did not reach a loss within {quality.CLOSE} nats of the floor")
    reasons += result["decoder_missed"]
    figure = _plot(result, trainings, folder / "incontext.png")
    return result | {"figure": str(figure), "ok": not reasons, "reasons": reasons}


def describe(result: dict[str, Any]) -> str:
    """The result as a small table."""
    if "length" not in result:
        return "\n".join([*decoder.describe(result), *result["reasons"]])
    rows = [f"{'per CPU-second, one core':<44}{'ours':>10}{'peer':>10}{'ratio':>8}"]
    for batch in (20, 512):
        ours, theirs = result[f"steps_per_s_{batch}"], result[f"peer_steps_per_s_{batch}"]
        label = f"environment steps online, {batch} environments"
        rows.append(f"{label:<44}{ours:>10,}{theirs:>10,}{result[f'deploy_ratio_{batch}']:>8.1f}")
    ours, theirs = result["labels_per_s"], result["peer_labels_per_s"]
    rows.append(f"{'labelled queries in training':<44}{ours:>10,}{theirs:>10,}{result['labels_ratio']:>8.1f}")
    ratio = "" if result["time_to_quality_ratio"] is None else f"{result['time_to_quality_ratio']:>8.1f}"
    label = f"CPU-seconds to {quality.CLOSE} nats above the floor"
    rows.append(f"{label:<44}{result['quality_cpu_s']:>10,.0f}{result['peer_quality_cpu_s']:>10,.0f}{ratio}")
    if result["time_to_quality_is_a_bound"]:
        rows.append(f"the peer was stopped after {quality.PEER_CONTEXTS:,} contexts: its time and the ratio are lower bounds")
    rows.append(
        f"a decision: {result['decision_us'][0]} us at an empty context, {result['decision_us'][-1]} us at "
        f"{result['length'][-1]:,} transitions, exponent {result['length_exponent']:.2f}; figure {result['figure']}"
    )
    if gpu := result["gpu"]:
        rows.append(
            f"{gpu['device']}: {gpu['labels_per_s']:,.0f} labels/s ({gpu['labels_share']:.0%} of its limit), "
            f"{gpu['decisions_per_s']:,.0f} decisions/s ({gpu['decisions_share']:.0%})"
        )
    return "\n".join([*rows, *decoder.describe(result), *result["reasons"]])


def _trainings(path: Path, seeds: range, report: Report) -> dict[str, Any]:
    """Results of the trainings ``ours/SEED`` and ``peer/SEED``; results stored for the same settings are reused."""
    settings = json.loads(json.dumps(_settings()))
    stored = json.loads(path.read_text()) if path.exists() else {}
    done: dict[str, Any] = stored["done"] if stored.get("settings") == settings else {}
    for seed in seeds:
        for side, train in (("ours", quality.ours), ("peer", quality.theirs)):
            if (name := f"{side}/{seed}") not in done:
                done[name] = train(seed, report)
                _save(path, {"settings": settings, "done": done})
    return {f"{side}/{seed}": done[f"{side}/{seed}"] for side in ("ours", "peer") for seed in seeds}


def _save(path: Path, content: dict[str, Any]) -> None:
    write_json(path, content)


def _settings() -> dict[str, Any]:
    """Everything that the result of a training depends on."""
    constants = {name: getattr(module, name) for module in (quality, peer) for name in vars(module) if name.isupper()}
    numbers = {name: value for name, value in constants.items() if isinstance(value, (int, float))}
    machine = {"torch": torch.__version__, "cpu": torch.backends.cpu.get_cpu_capability(), "kernel": bool(kinds("training"))}
    return numbers | {"model": asdict(quality.MODEL), "optim": asdict(quality.OPTIM)} | machine


def _time_to_quality(trainings: dict[str, Any]) -> dict[str, Any]:
    """CPU-seconds of both sides (medians over seeds) and their ratio; None if ours did not reach the target loss."""
    sides = {side: [training for name, training in trainings.items() if name.startswith(side)] for side in ("ours", "peer")}
    seconds = {side: statistics.median(training["cpu_s"] for training in found) for side, found in sides.items()}
    reached = all(training["reached"] for training in sides["ours"])
    return {
        "time_to_quality_ratio": round(seconds["peer"] / seconds["ours"], 1) if reached else None,
        "time_to_quality_is_a_bound": not all(training["reached"] for training in sides["peer"]),
        "quality_cpu_s": seconds["ours"],
        "peer_quality_cpu_s": seconds["peer"],
        "trainings": {
            name: {key: value for key, value in training.items() if key != "curve"} for name, training in trainings.items()
        },
    }


def _plot(result: dict[str, Any], trainings: dict[str, Any], path: Path) -> Path:
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    figure, (left, right) = pyplot.subplots(1, 2, figsize=(11, 4.2))
    for name, training in trainings.items():
        ours = name.startswith("ours")
        label = {"ours/0": "ours", "peer/0": "official layout"}.get(name)
        left.plot(*zip(*training["curve"], strict=True), color="tab:blue" if ours else "tab:orange", label=label, linewidth=1.3)
    left.axhline(quality.CLOSE, color="black", linewidth=0.8)
    left.set(xlabel="CPU-seconds of training", ylabel="held-out loss above the exact floor, nats", xscale="log", yscale="log")
    left.legend(fontsize=8)
    right.plot(result["length"], result["decision_us"], "o-", markersize=4)
    right.set(xlabel="transitions in the context", ylabel=f"a decision in {cost.ROWS} environments at once, us", xlim=(0, None))
    right.set_ylim(0, None)
    for axis in (left, right):
        axis.grid(alpha=0.25)
    figure.tight_layout()
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=120)
    pyplot.close(figure)
    return path
