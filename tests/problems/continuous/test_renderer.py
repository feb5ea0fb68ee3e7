"""A renderer that is not there matters only to what draws."""

import os
import subprocess
import sys

import pytest

from icrl_dist.problems.continuous import renderer
from icrl_dist.telemetry import processes
from tests.calls import failing

SCRIPT = """
import sys
import numpy as np
import icrl_dist
from icrl_dist.config.run import load
from icrl_dist.problems import registry
for name in sys.argv[1:]:
    problem = registry.of(load(name))
    one = icrl_dist.Variation(problem.split.train[0])
    env = problem.batch([one])
    env.reset([np.random.default_rng(0)])
    env.step(np.zeros((1, problem.spec.actions), np.float32))
    try:
        env.image(0)
    except RuntimeError as error:
        print(error)
"""


@pytest.mark.integration
@pytest.mark.parametrize("gl", ["osmesa", "nonsense"])
def test_simulations_run_and_drawing_says_one_line(gl):
    runs = ["dmc-cartpole-balance-laptop", "metaworld-laptop"]
    environment = {**processes.environment(), "MUJOCO_GL": gl, "LD_LIBRARY_PATH": ""}
    done = subprocess.run(
        processes.python("-W", "error::UserWarning", "-c", SCRIPT, *runs),
        env=environment,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    lines = done.stdout.splitlines()
    assert len(lines) in (0, 2), "osmesa may be installed"
    assert all(f"MUJOCO_GL={gl}: " in line and "install libegl1" in line for line in lines)
    assert gl != "nonsense" or len(lines) == 2


def test_an_error_that_is_not_of_a_renderer_is_raised(monkeypatch):
    monkeypatch.setenv("MUJOCO_GL", "disabled")
    monkeypatch.setattr("importlib.import_module", failing(ImportError("no MuJoCo")))
    with pytest.raises(ImportError, match="no MuJoCo"):
        renderer.imported("mujoco")
    assert os.environ["MUJOCO_GL"] == "disabled" and "mujoco" in sys.modules
