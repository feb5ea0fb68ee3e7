"""Tiny experts of every continuous problem, trained with a fixed seed, and a record of their histories.

``python -m tests.experts.recorded_histories`` records them in ``recorded_histories.json``.
"""

from __future__ import annotations

import hashlib
import json
import platform
import sys
import tempfile
from importlib import metadata
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np
import torch

from icrl_dist.config.run import make_run
from icrl_dist.config.sac import SACConfig
from icrl_dist.config.sections import AdversaryConfig, PretrainConfig, StreamConfig
from icrl_dist.experts import cache
from icrl_dist.problems.continuous.config import ControlConfig
from icrl_dist.problems.dmc import domains
from tests.jobs import do, jobs_of

FILE = Path(__file__).with_suffix(".json")
LOCKSTEP, SINGLE = 2, 1
"""Experts of a job: an undisturbed and a disturbed one in lockstep, or one that stable-baselines3 trains."""
CASES: dict[str, tuple[str, int, dict[str, Any]]] = {
    **{name: (name, LOCKSTEP, {}) for name in domains.PROBLEMS},
    **{
        f"{name}, qarl": (name, LOCKSTEP, {"forces": "qarl"})
        for name, one in domains.PROBLEMS.items()
        if one.forces["qarl"] != one.forces["paper"]
    },
    "metaworld-pick-place": ("metaworld-pick-place", LOCKSTEP, {}),
    "dmc-reacher-easy, stable-baselines3": ("dmc-reacher-easy", SINGLE, {}),
}
"""Name, problem, number of experts, and settings of the problem."""
_HORIZON, _EPISODES = 10, 6
_LIBRARIES = ("dm-control", "metaworld", "mujoco", "numpy", "stable-baselines3", "torch")


def histories(case: str) -> list[cache.History]:
    """The histories of a case, trained now on the CPU."""
    problem, experts, settings = CASES[case]
    rates: dict[str, Any] = dict.fromkeys(("actor_rate", "critic_rate", "temperature_rate"), 1e-3)
    with tempfile.TemporaryDirectory() as folder, mock.patch.object(torch.cuda, "is_available", lambda: False):
        sac = SACConfig((8, 8), batch=16, random_steps=20, warmup=20, update_every=2, steps=_HORIZON * _EPISODES, **rates)
        run = make_run(
            problem,
            method="icag",
            control=ControlConfig(train_tasks=4, test_tasks=2, horizon=_HORIZON, **settings),
            adversary=AdversaryConfig(count=experts - 1),
            sac=SACConfig(**{**vars(sac), "cache": folder}),
            pretrain=PretrainConfig(contexts=4 * experts, queries=2),
            stream=StreamConfig(job_tasks=1),
        )
        job = jobs_of(run)[0]
        do(run, job)
        found = [cache.load_any(variation, _HORIZON, run.sac, run.seed) for variation in job.variations]
    assert len(found) == experts
    return [history for history in found if history is not None]


def measured(case: str) -> dict[str, Any]:
    """The digest of all arrays of a case, and numbers that differ little between kinds of machines."""
    digest, numbers = hashlib.sha256(), []
    for history in histories(case):
        for array in history.arrays().values():
            digest.update(array.tobytes())
            numbers += summary(array)
    return {"digest": digest.hexdigest(), "numbers": numbers}


def summary(array: np.ndarray) -> list[float]:
    """Mean absolute value, and the mean with weights that differ for every element."""
    flat = array.astype(np.float64).ravel()
    return [float(f"{value:.6g}") for value in (np.abs(flat).mean(), (flat * np.cos(np.arange(flat.size))).mean())]


def libraries() -> dict[str, str]:
    """Versions of the libraries that decide bytes."""
    return {name: metadata.version(name) for name in _LIBRARIES}


def machine() -> list[str]:
    """What decides the last digits of a machine's results, beside its libraries."""
    info = Path("/proc/cpuinfo")
    lines = info.read_text().splitlines() if info.exists() else []
    cpu = {line for line in lines if line.startswith(("vendor_id", "cpu family", "model\t"))}
    return [platform.machine(), torch.backends.cpu.get_cpu_capability(), *(" ".join(line.split()) for line in sorted(cpu))]


def main() -> None:
    """Record all cases; refused if the code gives other bytes and EXPERTS_VERSION is still the recorded one."""
    torch.set_num_threads(1)
    before = json.loads(FILE.read_text()) if FILE.exists() else {"cases": {}, "version": None}
    cases = {case: measured(case) for case in CASES}
    same = ("version", cache.EXPERTS_VERSION), ("libraries", libraries()), ("machine", machine())
    changed = [case for case, old in before["cases"].items() if case in cases and cases[case] != old]
    if changed and all(before[name] == value for name, value in same):
        sys.exit(f"the bytes of {', '.join(changed)} have changed: raise EXPERTS_VERSION in icrl_dist/experts/cache.py first")
    FILE.write_text(json.dumps({**dict(same), "cases": cases}) + "\n")


if __name__ == "__main__":
    main()
