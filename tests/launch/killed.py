"""Begins a run again and again, and ends the process at each file operation in turn, without any cleaning up.

``python -m tests.launch.killed FOLDER RUN_FILE OVERWRITE [PARENT]``: run folder number n, FOLDER/n/run, is what a kill before
operation n leaves.  Prints how many operations there were.  It runs outside pytest, whose threads do not survive a fork.
"""

from __future__ import annotations

import os
import sys
from pathlib import Path
from typing import Any

from icrl_dist.config.run import Run, load
from icrl_dist.launch import train

OPERATIONS = {"mkdir", "write", "fsync", "replace", "rename", "link", "unlink", "rmdir", "flock"}
"""Functions in C, before each of which the process ends in turn: between any two of them at most empty files appear."""
DONE, KILLED, FAILED = 0, 9, 1


def begin(folder: Path, run: Run, overwrite: bool, source: tuple[Path, int] | None, operation: int) -> int:
    """Begin the run in a child process that ends before this operation; returns its exit code."""
    child = os.fork()
    if child:
        return os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
    left = operation

    def count(frame: object, event: str, function: Any) -> None:
        nonlocal left
        if event == "c_call" and function.__name__ in OPERATIONS:
            left -= 1
            if left < 0:
                os._exit(KILLED)

    try:
        sys.setprofile(count)
        train.prepare(run, folder, False, overwrite, source)
        sys.setprofile(None)
        os._exit(DONE)
    except Exception as error:
        print(error, file=sys.stderr, flush=True)
    os._exit(FAILED)


def main() -> None:
    folder, run = Path(sys.argv[1]), load(sys.argv[2])
    overwrite, source = sys.argv[3] == "overwrite", (Path(sys.argv[4]), 1) if sys.argv[4:] else None
    for operation in range(1000):
        if overwrite:
            train.prepare(run, folder / str(operation) / "run", False, False)
            (folder / str(operation) / "run" / "metrics.jsonl").write_text("of the old run\n")
        code = begin(folder / str(operation) / "run", run, overwrite, source, operation)
        assert code in (DONE, KILLED), code
        if code == DONE:
            print(operation)
            return


if __name__ == "__main__":
    main()
