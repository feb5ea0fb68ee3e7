"""Every Python process with this folder on PYTHONPATH imports this file: it makes one variation fail in its worker.

A test uses it to change worker processes that it does not start itself.  ``HOSTILE`` names the failure
in the variation's third step, ``HOSTILE_VARIATION`` is the ``repr`` of the variation.
"""

import os
import sys

if "HOSTILE" in os.environ and any(name in " ".join(sys.orig_argv) for name in ("default_worker.py", "hostile-worker")):
    import ctypes
    import signal
    import time

    from icrl_dist.problems.darkroom.problem import DarkRoomProblem

    def raise_an_error():
        raise ZeroDivisionError("the room broke")

    def sleep_for_ever():
        while True:
            time.sleep(1000)

    def hold_the_interpreter_in_c():
        ctypes.PyDLL(None).sleep(1000)  # PyDLL does not release the interpreter lock

    FAILURES = {
        "raise": raise_an_error,
        "sleep": sleep_for_ever,
        "hold": hold_the_interpreter_in_c,
        "segfault": lambda: ctypes.string_at(0),
        "kill": lambda: os.kill(os.getpid(), signal.SIGKILL),
        "exit": lambda: os._exit(3),
    }

    class Hostile:
        """A batch of environments that fails in its third step."""

        def __init__(self, batch):
            self._batch = batch
            self._steps = 0

        def __getattr__(self, name):
            return getattr(self._batch, name)

        def step(self, action):
            self._steps += 1
            if self._steps == 3:
                FAILURES[os.environ["HOSTILE"]]()
            return self._batch.step(action)

    real = DarkRoomProblem.batch

    def batch(problem, variations):
        """The real environments; they fail if the hostile variation is among them."""
        made = real(problem, variations)
        return Hostile(made) if any(repr(v) == os.environ["HOSTILE_VARIATION"] for v in variations) else made

    DarkRoomProblem.batch = batch  # type: ignore[method-assign]  # this process ends with it
