"""Read by every Python process that finds it on PYTHONPATH: makes one variation hostile to its worker.

This is how a test reaches into worker processes that it does not start itself.  ``HOSTILE`` is
what the variation does in its third step, ``HOSTILE_VARIATION`` its ``repr``.
"""

import os
import sys

if "HOSTILE" in os.environ and any(name in " ".join(sys.orig_argv) for name in ("default_worker.py", "hostile-worker")):
    import ctypes
    import signal
    import time

    from icrl_dist.problems import registry

    def raise_an_error():
        raise ZeroDivisionError("the room broke")

    def sleep_for_ever():
        while True:
            time.sleep(1000)

    def hold_the_interpreter_in_c():
        ctypes.PyDLL(None).sleep(1000)  # PyDLL keeps the lock of the interpreter

    DEEDS = {
        "raise": raise_an_error,
        "sleep": sleep_for_ever,
        "hold": hold_the_interpreter_in_c,
        "segfault": lambda: ctypes.string_at(0),
        "kill": lambda: os.kill(os.getpid(), signal.SIGKILL),
        "exit": lambda: os._exit(3),
    }

    class Hostile:
        """A batch of environments, one of which does its deed."""

        def __init__(self, batch):
            self._batch = batch
            self._steps = 0

        def __getattr__(self, name):
            return getattr(self._batch, name)

        def step(self, action):
            self._steps += 1
            if self._steps == 3:
                DEEDS[os.environ["HOSTILE"]]()
            return self._batch.step(action)

    real = registry.batch

    def batch(variations):
        """The real environments, unless the hostile variation is among them."""
        made = real(variations)
        return Hostile(made) if any(repr(v) == os.environ["HOSTILE_VARIATION"] for v in variations) else made

    registry.batch = batch
