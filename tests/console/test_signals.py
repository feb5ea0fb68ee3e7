"""The signals that end a program in order, and those that were ignored when it started."""

import contextlib
import signal

import pytest

from icrl_dist.console.signals import SIGNALS, interruptible, on_signals


@contextlib.contextmanager
def disposition(number, handler):
    before = signal.signal(number, handler)
    try:
        yield
    finally:
        signal.signal(number, before)


def test_a_lost_terminal_and_the_warnings_of_batch_systems_are_among_them():
    warnings = {signal.SIGUSR1, signal.SIGUSR2, signal.SIGXCPU}
    assert {signal.SIGINT, signal.SIGTERM, signal.SIGHUP} | warnings == set(SIGNALS)


@pytest.mark.parametrize("number", SIGNALS)
def test_each_signal_calls_stop_and_gets_its_handler_back(number):
    former, stopped = signal.getsignal(number), []
    with on_signals(lambda: stopped.append(number)):
        signal.raise_signal(number)
        signal.raise_signal(number)
    assert stopped == [number] * 2 and signal.getsignal(number) is former


@pytest.mark.parametrize("number", SIGNALS)
def test_an_ignored_signal_stays_ignored_also_after_other_code_set_a_handler(number):
    """``nohup`` ignores SIGHUP; a shell's script ignores SIGINT in a program that it starts with ``&``."""
    with disposition(number, signal.SIG_IGN), on_signals(lambda: pytest.fail("it was ignored")) as again:
        signal.raise_signal(number)
        signal.signal(number, signal.default_int_handler)  # as Ray does for SIGTERM
        again()
        signal.raise_signal(number)


@pytest.mark.parametrize("number", SIGNALS)
def test_an_interruptible_context_raises_at_every_signal(number):
    for _ in range(2):
        with pytest.raises(KeyboardInterrupt), interruptible():
            signal.raise_signal(number)


def test_within_another_context_the_inner_one_counts_and_the_outer_one_is_there_at_once_after_it():
    stopped = []
    with on_signals(lambda: stopped.append("outer")):
        with on_signals(lambda: stopped.append("inner")):
            signal.raise_signal(signal.SIGTERM)
        signal.raise_signal(signal.SIGTERM)
    assert stopped == ["inner", "outer"]
