"""A complete run from Python through Ray and Zenoh: the digests of one process, and a process left as it was."""

import json
import subprocess
import sys

from tests.e2e.training import SMOKE, equal, result_of

SCRIPT = """
import json, os, signal, sys
import icrl_dist, ray

def state():
    return [str(signal.getsignal(number)) for number in (signal.SIGINT, signal.SIGTERM)], dict(os.environ)

os.environ.pop("OMP_WAIT_POLICY", None)
os.environ["MUJOCO_GL"] = "disabled"  # set by the first import of a continuous problem
before = state()
made = icrl_dist.train(icrl_dist.load_run("smoke", *sys.argv[2:]), sys.argv[1], actors=1)
print(json.dumps({"same": state() == before, "ray": ray.is_initialized(), "deaths": made.result["worker_deaths"]}))
"""


def test_a_run_through_ray_has_the_digests_of_one_process_and_leaves_its_process_as_it_was(reference, tmp_path):
    names = [word.removeprefix("--").replace("-", "_") for word in SMOKE[1::2]]
    settings = [f"{name}={value}" for name, value in zip(names, SMOKE[2::2], strict=True)]
    settings[-1] = "evaluate.p=[0.0]"
    command = [sys.executable, "-c", SCRIPT, str(tmp_path / "run"), *settings]
    ran = subprocess.run(command, capture_output=True, text=True)
    assert ran.returncode == 0, ran.stderr
    assert ran.stdout.count("\n") == 1, "train prints nothing"
    assert json.loads(ran.stdout) == {"same": True, "ray": False, "deaths": 0}
    assert equal(result_of(tmp_path / "run"), reference)
