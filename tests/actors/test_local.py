"""Ray that does not start is started again, and a failed start leaves no process."""

import subprocess
import sys

import psutil
import pytest

from actors import local

CHILD = "import subprocess, sys; subprocess.run([sys.executable, '-c', 'import time; time.sleep(600)'])"


class FailingRay:
    """A fake Ray that starts a process with a child process; the first ``failures`` attempts then fail."""

    def __init__(self, failures):
        self.failures, self.started, self.shutdowns = failures, [], 0

    def init(self, **options):
        assert options["num_cpus"] == 2
        process = subprocess.Popen([sys.executable, "-c", CHILD])
        while not psutil.Process(process.pid).children():
            pass
        self.started.append([process, *psutil.Process(process.pid).children()])
        if len(self.started) <= self.failures:
            raise Exception("The current node timed out.\nOr something else did.")

    def shutdown(self):
        self.shutdowns += 1

    def alive(self):
        return [[p.pid for p in family if psutil.pid_exists(p.pid)] for family in self.started]


@pytest.fixture
def failing_ray():
    made = []

    def make(failures):
        made.append(FailingRay(failures))
        return made[-1]

    yield make
    for ray in made:
        for process, child in ray.started:
            if psutil.pid_exists(child.pid):
                child.kill()
            process.wait(10)


def test_ray_is_started_again_and_only_the_processes_of_failed_starts_are_ended(failing_ray):
    with subprocess.Popen([sys.executable, "-c", "input()"], stdin=subprocess.PIPE) as other:
        ray, notes = failing_ray(2), list[str]()
        local.start_ray(ray, notes.append, num_cpus=2)
        assert other.poll() is None
        other.communicate(b"\n")
    assert [len(family) for family in ray.alive()] == [0, 0, 2] and ray.shutdowns == 2
    text = "Ray did not start on this machine (The current node timed out.): starting it again, "
    assert notes == [f"{text}2 of 3", f"{text}3 of 3"]


@pytest.mark.parametrize(("stopped", "tries"), [(False, 3), (True, 1)])
def test_starting_fails_after_three_attempts_or_when_stopped(failing_ray, stopped, tries):
    ray = failing_ray(3)
    with pytest.raises(RuntimeError, match=rf"The current node timed out\.\), tried {tries} times"):
        local.start_ray(ray, lambda text: None, lambda: stopped, num_cpus=2)
    assert ray.alive() == [[]] * tries
