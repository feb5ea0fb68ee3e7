"""Ctrl-C and SIGTERM as an event of the program."""

from __future__ import annotations

import contextlib
import signal
import threading
from collections.abc import Callable, Iterator
from typing import Any


@contextlib.contextmanager
def on_signals(stop: Callable[[], None]) -> Iterator[Callable[[], object]]:
    """Call ``stop`` on SIGINT and SIGTERM.  Yields a function that sets the handlers again after other code replaced them.

    The former handlers are set at the end.  Outside the main thread Python allows no handlers, and nothing is changed.
    """
    numbers = (signal.SIGINT, signal.SIGTERM) if _in_main_thread() else ()
    signals = [number for number in numbers if signal.getsignal(number) is not None]  # another could not be set again

    def handle() -> list[Any]:
        return [signal.signal(number, lambda *_: stop()) for number in signals]

    before = handle()
    try:
        yield handle
    finally:
        for number, handler in zip(signals, before, strict=True):
            signal.signal(number, handler)


def _in_main_thread() -> bool:
    return threading.current_thread() is threading.main_thread()
