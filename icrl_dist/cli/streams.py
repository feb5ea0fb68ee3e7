"""The standard streams of the command: closed ones, a terminal that goes away, a reader that closes its pipe."""

from __future__ import annotations

import errno
import io
import os
import select
import sys
from typing import TYPE_CHECKING

from icrl_dist.cli.exit_codes import BROKEN_PIPE

if TYPE_CHECKING:
    from _typeshed import ReadableBuffer as Buffer


class _Terminal(io.FileIO):
    """A terminal.  When it is gone (a dropped ssh), nothing is shown from then on; whether the program ends is for SIGHUP."""

    def write(self, data: Buffer, /) -> int:
        try:
            return super().write(data)
        except OSError as error:
            if error.errno != errno.EIO:
                raise
            discard(self.fileno())
            return memoryview(data).nbytes


def prepare() -> None:
    """Make the standard streams safe to use.

    A closed one (``<&-``, or a program that starts as a daemon) leads to /dev/null: otherwise the next file or pipe
    would get its number.  Output to a terminal that is gone is discarded.
    """
    for number, name in enumerate(("stdin", "stdout", "stderr")):
        try:
            os.fstat(number)
        except OSError:
            os.open(os.devnull, os.O_RDWR)  # it gets the lowest free number, this one
            os.set_inheritable(number, True)
        stream = getattr(sys, name)
        if stream is None:
            setattr(sys, name, os.fdopen(number, "w" if number else "r", closefd=False))
        elif number and stream is getattr(sys, f"__{name}__") and stream.isatty():
            raw = io.BufferedWriter(_Terminal(number, "w", closefd=False))
            setattr(sys, name, io.TextIOWrapper(raw, stream.encoding, stream.errors, line_buffering=True))


def end_of_output() -> int:
    """The exit code after a BrokenPipeError because the reader of standard output has closed it, as ``head`` does.

    Must be called while that error is handled; it is raised again if another pipe caused it.
    """
    poll = select.poll()
    for stream in (sys.stdout, sys.stderr):
        poll.register(stream.fileno(), 0)
    closed = [number for number, event in poll.poll(0) if event & select.POLLERR]
    if sys.stdout.fileno() not in closed:
        raise
    for number in closed:
        discard(number)  # what is flushed at exit
    return BROKEN_PIPE


def discard(number: int) -> None:
    """Let a file descriptor lead to /dev/null."""
    null = os.open(os.devnull, os.O_WRONLY)
    os.dup2(null, number)
    os.close(null)
