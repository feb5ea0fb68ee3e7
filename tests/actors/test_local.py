"""Ray that does not come up on this machine is started again, and leaves nothing behind."""

import subprocess
import sys

import psutil
import pytest

from actors import local

CHILD = "import subprocess, sys; subprocess.run([sys.executable, '-c', 'import time; time.sleep(600)'])"


class ReluctantRay:
    """Starts a process that starts another, then fails, so many times."""

    def __init__(self, failures):
        self.failures, self.started, self.shut = failures, [], 0

    def init(self, **options):
        assert options["num_cpus"] == 2
        process = subprocess.Popen([sys.executable, "-c", CHILD])
        while not psutil.Process(process.pid).children():
            pass
        self.started.append([process, *psutil.Process(process.pid).children()])
        if len(self.started) <= self.failures:
            raise Exception("The current node timed out.\nOr something else did.")

    def shutdown(self):
        self.shut += 1

    def alive(self):
        return [[p.pid for p in family if psutil.pid_exists(p.pid)] for family in self.started]


@pytest.fixture
def reluctant():
    made = []

    def make(failures):
        made.append(ReluctantRay(failures))
        return made[-1]

    yield make
    for ray in made:
        for process, child in ray.started:
            if psutil.pid_exists(child.pid):
                child.kill()
            process.wait(10)


def test_it_is_started_again_and_what_a_failed_start_left_is_ended_and_nothing_else(reluctant):
    with subprocess.Popen([sys.executable, "-c", "input()"], stdin=subprocess.PIPE) as other:
        ray, notes = reluctant(2), []
        local.start_ray(ray, notes.append, num_cpus=2)
        assert other.poll() is None
        other.communicate(b"\n")
    assert [len(family) for family in ray.alive()] == [0, 0, 2] and ray.shut == 2
    said = "Ray did not start on this machine (The current node timed out.): starting it again, "
    assert notes == [f"{said}2 of 3", f"{said}3 of 3"]


@pytest.mark.parametrize(("stopped", "tries"), [(False, 3), (True, 1)])
def test_it_is_given_up_after_three_times_or_when_nobody_wants_it(reluctant, stopped, tries):
    ray = reluctant(3)
    with pytest.raises(RuntimeError, match=rf"The current node timed out\.\), tried {tries} times"):
        local.start_ray(ray, lambda text: None, lambda: stopped, num_cpus=2)
    assert ray.alive() == [[]] * tries
