"""Dataset and weights of a run with ``learner.reproducible = "any-machine"`` depend on no vector instruction."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from icrl_dist.models.compiled import kinds

FEATURES = "X86_V3 X86_V4 AVX512_ICL AVX512_SPR"
"""The instruction sets that numpy chooses from when it runs."""


@pytest.mark.integration
@pytest.mark.skipif(not kinds("training"), reason="the training kernel was not built")
def test_two_rounds_have_the_same_digests_by_every_instruction_set(tmp_path: Path) -> None:
    """Torch, numpy and the kernels are held to fewer instructions, each process to others, with one or two threads."""
    narrow, wide = kinds("training")[0], kinds("training")[-1]
    cases = [
        ({"ATEN_CPU_CAPABILITY": "default", "NPY_DISABLE_CPU_FEATURES": FEATURES}, narrow, 1),
        ({"ATEN_CPU_CAPABILITY": "avx2"}, wide, 2),
        ({}, narrow, 3),
    ]
    command = [sys.executable, "-m", "tests.training.smoke_digests"]
    started = [
        subprocess.Popen(
            [*command, str(tmp_path / str(number)), kind, str(threads)],
            env=os.environ | changed,
            stdout=subprocess.PIPE,
            text=True,
        )
        for number, (changed, kind, threads) in enumerate(cases)
    ]
    outputs = [process.communicate()[0] for process in started]
    assert [process.returncode for process in started] == [0] * len(cases)
    digests = [tuple(json.loads(output)) for output in outputs]
    assert len(digests[0]) == 2 and len(set(digests)) == 1, digests
