"""The soak and recovery benchmarks: their arithmetic and the arguments that they refuse.  The runs themselves are commands."""

import subprocess
import sys

import pytest

from icrl_dist.bench import recovery, soak
from icrl_dist.config.run import ConfigError


def test_a_slope_is_in_megabytes_per_minute_after_the_warm_up_and_ignores_spikes():
    seconds = 100.0
    points = [(float(t), 50.0 + (t < 40) * 2 * t + 0.6 * t / 60) for t in range(100)]
    assert soak._slope(points, seconds) == pytest.approx(0.6, abs=1e-6)
    points[70] = (70.0, 500.0)
    points[90] = (90.0, 900.0)
    assert soak._slope(points, seconds) == pytest.approx(0.6, abs=0.02)


HOLDER = """
import mmap
input()
block = mmap.mmap(-1, 40 << 20, flags=mmap.MAP_PRIVATE | mmap.MAP_ANONYMOUS)
for page in range(0, len(block), mmap.PAGESIZE):
    block[page] = 1
print("held", flush=True)
input()
"""


def test_the_memory_of_a_process_is_measured_and_grows_with_its_allocations():
    command, pipe = [sys.executable, "-c", HOLDER], subprocess.PIPE
    with subprocess.Popen(command, text=True, bufsize=1, stdin=pipe, stdout=pipe) as holder:
        assert holder.stdin is not None and holder.stdout is not None
        before = dict(soak._memory(holder.pid))
        holder.stdin.write("\n")
        assert holder.stdout.readline() == "held\n"
        after = dict(soak._memory(holder.pid))
        holder.communicate("\n")
    (name,) = before
    assert name == f"icrl-dist train {holder.pid}"
    assert 38 < after[name] - before[name] < 60  # its start may not have been complete at the first measurement


def test_too_short_times_and_zero_numbers_are_refused(tmp_path):
    with pytest.raises(ConfigError, match="seconds = 5: must be at least 30"):
        soak.run(5, tmp_path)
    for numbers in ({"trajectories": 0}, {"kills": 0}):
        with pytest.raises(ConfigError, match="must be above 0"):
            recovery.run(tmp_path, **numbers)
    assert not list(tmp_path.iterdir())
