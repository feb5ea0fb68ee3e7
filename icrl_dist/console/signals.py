"""The signals that end a program in order: Ctrl-C, SIGTERM, a lost terminal, the warning of a batch system."""

from __future__ import annotations

import contextlib
import signal
import threading
from collections.abc import Callable, Iterator
from typing import Any

SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP, signal.SIGUSR1, signal.SIGUSR2, signal.SIGXCPU)
"""The last three are warnings: batch systems send them before a limit, and the kernel sends the last at a limit of CPU time."""


@contextlib.contextmanager
def on_signals(stop: Callable[[], None]) -> Iterator[Callable[[], object]]:
    """Call ``stop`` on each of ``SIGNALS``.  Yields a function that sets the handlers again after other code replaced them.

    A signal that is ignored stays ignored: ``nohup`` starts a program so that SIGHUP does not end it, and a shell
    starts a script's background programs so that Ctrl-C does not.  The former handlers are set at the end.
    Outside the main thread Python allows no handlers, and nothing is changed.
    """
    found = {number: signal.getsignal(number) for number in SIGNALS if _in_main_thread()}
    # Another could not be set again.
    before = {number: handler for number, handler in found.items() if handler is not None}

    def handle() -> list[Any]:
        ignored = signal.SIG_IGN
        return [signal.signal(n, ignored if before[n] == ignored else lambda *_: stop()) for n in before]

    handle()
    try:
        yield handle
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def interruptible() -> contextlib.AbstractContextManager[object]:
    """A context in which each of ``SIGNALS`` raises KeyboardInterrupt, for work that can be repeated."""

    def interrupt() -> None:
        raise KeyboardInterrupt

    return on_signals(interrupt)


def _in_main_thread() -> bool:
    return threading.current_thread() is threading.main_thread()
