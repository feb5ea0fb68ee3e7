"""Images show the robot: its pixels are counted in all six domains of DeepMind Control, with the masses of other tasks."""

from __future__ import annotations

import functools
import json
import os
import subprocess
import sys

import pytest

pytestmark = pytest.mark.integration

SCRIPT = """
import json
import numpy as np
from icrl_dist import Variation, make
from icrl_dist.problems.dmc import domains
found = {}
for kind, one in {problem.domain: (kind, problem) for kind, problem in domains.PROBLEMS.items()}.values():
    env = make(Variation(domains.grid(kind, 2)[1].replace(horizon=3)), "rgb_array")
    env.reset(seed=0)
    image = env.render()
    physics = env._batch.simulation._envs[0].physics
    number, kinds = physics.render(240, 320, camera_id=0, segmentation=True).transpose(2, 0, 1)
    moving = np.isin(number, np.flatnonzero(physics.model.ptr.geom_bodyid > 0)) & (kinds == 5)
    found[one.domain] = [image.shape, int(moving.sum()), float(image[moving].std())]
print(json.dumps(found))
"""


@functools.cache
def drawn() -> dict[str, tuple[list[int], int, float]]:
    """Shape, the robot's pixels, and how these differ in brightness, by domain; skips where nothing renders."""
    reasons = []
    for back_end in ("egl", "osmesa"):
        environ = {**os.environ, "MUJOCO_GL": back_end}
        ran = subprocess.run([sys.executable, "-c", SCRIPT], capture_output=True, text=True, env=environ)
        if ran.returncode == 0:
            found: dict[str, tuple[list[int], int, float]] = json.loads(ran.stdout.splitlines()[-1])
            return found
        last = ran.stderr.strip().splitlines()[-1]
        assert "cannot render here" in last or "OpenGL" in ran.stderr, ran.stderr
        reasons.append(f"{back_end}: {last}")
    pytest.skip(f"no renderer works here: {'; '.join(reasons)}")


@pytest.mark.timeout(300)
def test_the_robot_is_in_the_image_in_every_domain() -> None:
    found = drawn()
    assert len(found) == 6
    for domain, (shape, pixels, contrast) in found.items():
        assert shape == [240, 320, 3]
        assert pixels > 100 and contrast > 5, f"{domain}: {pixels} pixels show the robot"
