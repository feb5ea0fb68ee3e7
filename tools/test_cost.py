"""Measure the CPU time of each test, its child processes included, or compare two measurements.

Usage, from the repository's root (further arguments go to pytest, which runs in one process)::

    python tools/test_cost.py measure after.jsonl [tests/e2e ...]
    python tools/test_cost.py show after.jsonl [--before before.jsonl] [--tests 20]

The CPU time hardly depends on what else the machine does, so it can be compared where wall time cannot.  Processes
that outlive their parent (Ray's, for instance) are counted: they become children of this command.
"""

from __future__ import annotations

import argparse
import contextlib
import ctypes
import json
import os
import resource
import subprocess
import sys
import time
from collections import defaultdict
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import psutil
import pytest

_PR_SET_CHILD_SUBREAPER = 36
_TIERS = ("unit", "integration", "e2e")


class Cost:
    """The pytest plugin that writes for each test its CPU seconds, its wall seconds, the processes it started, its tier."""

    def __init__(self, file: Path) -> None:
        self.file = file
        self.file.write_text("")
        self.started = 0
        sys.addaudithook(self._count)

    def _count(self, event: str, _: object) -> None:
        self.started += event in ("subprocess.Popen", "os.fork", "os.posix_spawn")

    def pytest_collection_finish(self) -> None:
        """Write the CPU time up to here."""
        self._write("collection", "collection", _cpu_here(), 0.0, 0)

    @pytest.hookimpl(wrapper=True)
    def pytest_runtest_protocol(self, item: pytest.Item) -> Iterator[None]:
        """Write what this test cost, with the fixtures that were made for it."""
        cpu, wall, started = _cpu_elsewhere() + _cpu_here(), time.monotonic(), self.started
        try:
            return (yield)
        finally:
            cpu = _cpu_here() + _cpu_elsewhere() - cpu
            tier = next((tier for tier in _TIERS if item.get_closest_marker(tier)), "no tier")
            self._write(item.nodeid, tier, cpu, time.monotonic() - wall, self.started - started)

    def _write(self, test: str, tier: str, cpu: float, wall: float, processes: int) -> None:
        row = {"test": test, "tier": tier, "cpu": round(cpu, 3), "wall": round(wall, 3), "processes": processes}
        with self.file.open("a") as file:
            file.write(json.dumps(row) + "\n")


def _cpu_here() -> float:
    """CPU seconds of this process and of its children that have ended and were waited for."""
    used = [resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
    return sum(one.ru_utime + one.ru_stime for one in used)


def _cpu_elsewhere() -> float:
    """CPU seconds of the descendants that still run, and of those that the command above waited for."""
    above = psutil.Process(os.getppid())
    times = above.cpu_times()
    total = float(times.children_user + times.children_system)
    for process in above.children(recursive=True):
        if process.pid != os.getpid():
            with contextlib.suppress(psutil.NoSuchProcess):
                total += sum(process.cpu_times()[:4])
    return total


def measure(file: Path, arguments: list[str]) -> int:
    """Run pytest with these arguments; returns its exit code."""
    if ctypes.CDLL(None).prctl(_PR_SET_CHILD_SUBREAPER, 1, 0, 0, 0) != 0:
        print("warning: processes that outlive their parent are not counted", file=sys.stderr)
    inside = [sys.executable, __file__, "inside", str(file.resolve()), "-n", "0", *arguments]
    environment = {name: value for name, value in os.environ.items() if name != "PYTHONDONTWRITEBYTECODE"}  # as in the Makefile
    pid = subprocess.Popen(inside, env=environment).pid
    while True:
        ended, status = os.wait()  # orphans too
        if ended == pid:
            return os.waitstatus_to_exitcode(status)


def _inside(file: Path, arguments: list[str]) -> int:
    sys.path[0] = str(Path.cwd())  # as for python -m pytest
    return int(pytest.main(arguments, plugins=[Cost(file)]))


def _read(file: Path | None) -> list[dict[str, Any]]:
    return [json.loads(line) for line in file.read_text().splitlines()] if file else []


def show(file: Path, before: Path | None, tests: int) -> None:
    """Print CPU seconds by tier, by file, and of the tests that cost most."""
    now, then = _read(file), _read(before)
    for column in ("tier", "file"):
        print(f"\n{'CPU s':>8} {'before':>8}  {column}")
        sums: dict[str, list[float]] = defaultdict(lambda: [0.0, 0.0])
        for place, rows in enumerate((now, then)):
            for row in rows:
                sums[row["test"].partition("::")[0] if column == "file" else row["tier"]][place] += row["cpu"]
        for name, (after, former) in sorted(sums.items(), key=lambda item: -max(item[1])):
            print(f"{after:8.1f} {former:8.1f}  {name}")
    print(f"{sum(row['cpu'] for row in now):8.1f} {sum(row['cpu'] for row in then):8.1f}  total")
    print(f"\n{'CPU s':>8} {'wall s':>8} {'started':>8}  test")
    for row in sorted(now, key=lambda row: -row["cpu"])[:tests]:
        print(f"{row['cpu']:8.1f} {row['wall']:8.1f} {row['processes']:8d}  {row['test']} ({row['tier']})")


def main() -> int:
    """The command line."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    commands = parser.add_subparsers(dest="command", required=True)
    for name in ("measure", "inside", "show"):
        command = commands.add_parser(name)
        command.add_argument("file", type=Path)
        if name == "show":
            command.add_argument("--before", type=Path)
            command.add_argument("--tests", type=int, default=20)
    options, rest = parser.parse_known_args()
    if options.command == "show":
        show(options.file, options.before, options.tests)
        return 0
    return (measure if options.command == "measure" else _inside)(options.file, rest)


if __name__ == "__main__":
    sys.exit(main())
