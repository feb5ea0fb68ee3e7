"""Record the digests and returns of small runs of every kind, or compare them with a record.

A refactoring must not change a byte of what runs produce.  Usage, from the repository's root::

    python tools/digests.py record digests.json
    python tools/digests.py compare digests.json [--only smoke]

Digests depend on library versions, and on the processor where torch fits or decides, or where a simulator or a SAC expert
computes.  So a record is valid on one machine only and is not committed.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

_INLINE, _RAY = ("--engine", "inline"), ("--engine", "ray", "--actors", "2")
_FEW = ("--evaluate.episodes", "3", "--evaluate.seeds", "1", "--learner.threads", "1")
_COMMITTED = (
    *("--pretrain.contexts", "320", "--pretrain.steps", "30", "--dagger.rounds", "1", "--dagger.trials", "2"),
    *("--dagger.steps", "10", "--optim.transitions", "800", "--optim.batch", "8"),
)
_GAME = (
    *("--sac.steps", "1600", "--sac.random-steps", "200", "--sac.warmup", "300", "--sac.update-every", "4"),
    *("--pretrain.contexts", "64", "--pretrain.steps", "20", "--pretrain.queries", "20", "--optim.batch", "4"),
    *("--icaa.trials", "3", "--icaa.context-trials", "1", "--icaa.steps", "10", "--optim.transitions", "1600"),
)
CASES: dict[str, tuple[str, ...]] = {
    **{
        f"smoke-{method}-{engine[1]}": ("smoke", "--method", method, *engine)
        for method in ("dpt", "icag", "icaa")
        for engine in (_INLINE, _RAY)
    },
    "demo": (
        "demo",
        *_INLINE,
        *("--pretrain.contexts", "390", "--pretrain.steps", "60", "--icaa.trials", "7", "--icaa.context-trials", "3"),
        *("--icaa.steps", "20"),
    ),
    "committed": ("darkroom-committed", *_INLINE, *_COMMITTED),
    "cartpole-icag": ("dmc-cartpole-balance-laptop", *_INLINE, *_GAME),
    "cartpole-icaa": ("dmc-cartpole-balance-laptop", "--method", "icaa", *_INLINE, *_GAME),
    "metaworld": (
        "metaworld-laptop",
        *_INLINE,
        *("--control.train-tasks", "10", "--control.test-tasks", "2", "--control.horizon", "60"),
        *("--pretrain.contexts", "40", "--pretrain.steps", "20", "--pretrain.queries", "20", "--optim.batch", "4"),
    ),
}
"""The command line of each run."""


def run(name: str, folder: Path) -> dict[str, object]:
    """Run one case in ``folder``; returns its digests and the returns that its evaluation printed."""
    given = (*CASES[name], *_FEW, "--out", str(folder / name), "--json")
    if "-laptop" in CASES[name][0]:
        given += ("--sac.cache", str(folder / f"cache-{name}"))
    command = [sys.executable, "-m", "icrl_dist.cli", "train", *given]
    environment = os.environ | {
        "OMP_NUM_THREADS": "1",
        "PYTHONPATH": os.pathsep.join((str(Path.cwd()), os.environ.get("PYTHONPATH", ""))),
    }
    done = subprocess.run(command, capture_output=True, text=True, env=environment, check=False)
    if done.returncode:
        raise SystemExit(f"{name}: exit code {done.returncode}\n{done.stderr[-2000:]}")
    result = json.loads(done.stdout.splitlines()[-1])
    found = {key: result[key] for key in ("dataset_digest", "weights_digest", "trajectories")}
    returns = [[row["agent"], row["p"], row["episodes"], row["optimum"]] for row in result["rows"]]
    return found | {"surprise": result["surprise"], "returns": returns}


def main() -> int:
    """Exit code 1 if a case differs from the record."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("act", choices=("record", "compare"))
    parser.add_argument("file", type=Path)
    parser.add_argument("--only", default="", help="cases whose name begins so")
    parser.add_argument("--jobs", type=int, default=2, help="runs at a time")
    given = parser.parse_args()
    names = [name for name in CASES if name.startswith(given.only)]
    with tempfile.TemporaryDirectory() as folder, ThreadPoolExecutor(given.jobs) as pool:
        found = dict(zip(names, pool.map(lambda name: run(name, Path(folder)), names), strict=True))
    if given.act == "record":
        given.file.write_text(json.dumps(found, indent=1) + "\n")
        print(f"{len(found)} cases recorded in {given.file}")
        return 0
    recorded = json.loads(given.file.read_text())
    differing = {name: [key for key in found[name] if found[name][key] != recorded[name][key]] for name in names}
    for name, keys in differing.items():
        print(f"{name:<22} {'equal' if not keys else 'DIFFERS: ' + ', '.join(keys)}")
        for key in keys:
            print(f"    {key}: {str(recorded[name][key])[:200]}\n      now: {str(found[name][key])[:200]}")
    return 1 if any(differing.values()) else 0


if __name__ == "__main__":
    sys.exit(main())
