"""Commands as Ray tasks, with a Ray that runs nothing."""

import time
from types import SimpleNamespace

import pytest

from actors import tasks


class Ray:
    """Tasks that have ended with ``answer``, a value or an error; None: that run."""

    exceptions = SimpleNamespace(TaskCancelledError=InterruptedError)

    def __init__(self, answer):
        self.answer, self.cancelled, self.asked = answer, [], None

    def remote(self, num_cpus):
        assert num_cpus == 1

        def remote(*arguments):
            self.asked = arguments
            return "reference"

        return lambda function: SimpleNamespace(remote=remote)

    def wait(self, references, timeout):
        assert timeout == 0
        return ([], references) if self.answer is None else (references, [])

    def get(self, reference):
        if isinstance(self.answer, Exception):
            raise self.answer
        return self.answer

    def cancel(self, reference, force):
        self.cancelled.append((reference, force))


@pytest.mark.parametrize(
    ("answer", "code"), [(None, None), (0, 0), (-9, -9), (InterruptedError(), tasks.CANCELLED), (OSError("gone"), tasks.LOST)]
)
def test_a_task_has_the_exit_code_of_its_command(tmp_path, answer, code):
    ray = Ray(answer)
    task = tasks.start(ray, ["-m", "x"], {"A": "1"}, b"message\n", tmp_path / "log")
    assert ray.asked == (["-m", "x"], {"A": "1"}, b"message\n", str(tmp_path / "log"))
    assert task.poll() == code and ("gone" in task.error) == (code == tasks.LOST)
    task.stop()
    task.kill()
    assert ray.cancelled == [("reference", False), ("reference", True)]


def test_a_node_without_the_folder_says_so(tmp_path):
    with pytest.raises(FileNotFoundError, match="not on this node; use a folder that all nodes share"):
        tasks._run(["-c", ""], {}, b"", str(tmp_path / "missing" / "log"))


@pytest.mark.integration
def test_the_command_gets_its_message_and_ends_when_the_task_is_cancelled(tmp_path, monkeypatch):
    script = "import os, sys; print(sys.stdin.readline(), os.environ['A'], flush=True); sys.stdin.read(); print('closed')"
    log = tmp_path / "log"
    pause = time.sleep

    def cancelled(seconds):  # as Ray cancels a task
        pause(0.02)
        if log.stat().st_size:
            raise KeyboardInterrupt

    monkeypatch.setattr(tasks, "time", SimpleNamespace(sleep=cancelled))
    with pytest.raises(KeyboardInterrupt):
        tasks._run(["-c", script], {"A": "1"}, b"message\n", str(log))
    assert log.read_text().split() == ["message", "1", "closed"]
