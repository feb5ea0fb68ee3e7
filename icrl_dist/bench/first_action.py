"""Seconds from the start of Python to the first action of an agent: through the compiled decoder, and through torch.

New processes of both alternate, because the speed of a machine varies.  Others only import numpy: that is the floor.
"""

from __future__ import annotations

import subprocess
import time
from typing import Any

from icrl_dist.models.compiled import kinds
from icrl_dist.telemetry import processes

BOUND = 0.5
"""Largest share of torch's time that the compiled decoder may take, in CPU time and in wall time."""

_ACT = "import icrl_dist\nicrl_dist.load_agent('darkroom', seed=0, decoder={!r}).act([[0, 0]])"


def sides() -> dict[str, str]:
    """What each side executes, by its name; ``kernel`` only where it was built."""
    built = {"kernel": _ACT.format("kernel")} if kinds() else {}
    return {"numpy": "import numpy", **built, "torch": _ACT.format("torch")}


def run(rounds: int = 10) -> dict[str, Any]:
    """The shortest CPU and wall time of each side in so many rounds, after one that writes byte code, in seconds.

    The ratios are those of ``kernel`` to ``torch``; None where the kernel was not built.  ``ok`` is false if one is above
    ``BOUND``; ``reasons`` lists these ratios.
    """
    measured: dict[str, list[tuple[float, float]]] = {}
    for turn in range(rounds + 1):
        for name, use in sides().items():
            found = _seconds(use)
            if turn:
                measured.setdefault(name, []).append(found)
    cpu, wall = ({name: min(one[i] for one in all) for name, all in measured.items()} for i in (0, 1))
    ratios = {
        f"{kind}_ratio": best["kernel"] / best["torch"] if "kernel" in best else None
        for kind, best in (("cpu", cpu), ("wall", wall))
    }
    reasons = [f"{name} {ratio:.2f}, above {BOUND:g}" for name, ratio in ratios.items() if ratio is not None and ratio > BOUND]
    return {"rounds": rounds, "cpu_s": cpu, "wall_s": wall, **ratios, "bound": BOUND, "ok": not reasons, "reasons": reasons}


def _seconds(use: str) -> tuple[float, float]:
    """CPU and wall time of a new Python process until it has executed this."""
    script = f"{use}\nimport time\nprint(time.process_time(), flush=True)"
    began = time.perf_counter()
    command = processes.python("-c", script)
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True, env=processes.environment()) as process:
        assert process.stdout is not None
        line = process.stdout.readline()
        wall = time.perf_counter() - began
    if process.returncode:
        raise RuntimeError(f"bench first-action: a process ended with exit code {process.returncode}: see its error above")
    return float(line), wall


def describe(result: dict[str, Any]) -> str:
    """The result as text."""
    rows = [
        f"{name:7}{result['cpu_s'][name]:6.2f} CPU-seconds{result['wall_s'][name]:6.2f} s of wall time"
        for name in result["cpu_s"]
    ]
    if result["cpu_ratio"] is None:
        return "\n".join([*rows, "the compiled decoder was not built here: `icrl-dist doctor` says what it needs"])
    ratios = f"kernel / torch: {result['cpu_ratio']:.2f} of the CPU time, {result['wall_ratio']:.2f} of the wall time"
    return "\n".join([*rows, f"{ratios} (bound {result['bound']:g}; best of {result['rounds']})"])
