"""Two rounds of a small ICAA run in one process, by one instruction set of the kernels; prints the digests as JSON.

``python -m tests.training.smoke_digests FOLDER KIND THREADS``
"""

from __future__ import annotations

import json
import sys
from dataclasses import replace
from pathlib import Path

import icrl_dist
from icrl_dist.models import kernel, training_kernel
from icrl_dist.models.compiled import kinds


def main(folder: str, kind: str, threads: str) -> None:
    run = icrl_dist.load_run("smoke")
    learner = replace(run.learner, threads=int(threads), reproducible="any-machine")
    run = replace(run, learner=learner, evaluate=replace(run.evaluate, episodes=2, seeds=1))
    found = kinds("training")
    only = found[: found.index(kind) + 1]
    for module in (kernel, training_kernel):
        setattr(module, "kinds", lambda name="decoder": only)  # noqa: B010
    result = icrl_dist.train(run, out=Path(folder), engine="inline").result
    print(json.dumps([result["dataset_digest"], result["weights_digest"]]))


if __name__ == "__main__":
    main(*sys.argv[1:])
