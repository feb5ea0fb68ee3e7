"""The commands in a text of the documentation, and what a shell calls for them.

Blocks of commands are fenced blocks tagged ``sh`` and indented blocks; single commands are code spans that begin
with ``icrl-dist``.  A shell runs each of them with a PATH of recording programs, so nothing else is started.
"""

from __future__ import annotations

import os
import re
import shutil
import subprocess
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

PLACEHOLDERS = {
    "WORKER_IPS": "192.0.2.11 192.0.2.12",
    "HEAD_IP": "192.0.2.10",
    "FOLDER": "certificates",
    "HOST": "192.0.2.10",
    "PORT": "7447",
    "USER": "ubuntu",
    "KEY": "key",
    "FILE": "rates.json",
    "RUN_DIR": "runs/demo",
    "IDENTITY": "adapt/0/3/1/7",
    "ROUND": "0",
    "CHECKPOINT": "runs/demo/checkpoints/version-0001.npz",
    "RUN": "demo",
    "N": "4",
    "experts-RUN": "experts-dmc-cartpole-balance-laptop",
    "bench NAME": "bench env",
    "train NAME": "train smoke",
    "SECTION.NAME=VALUE": "adversary.count=4",
    "COMMAND": "train",
    "SEED": "1",
    "[HOST ...]": "learner.example",
}
"""What a reader puts in the place of a word in capitals."""

_STUB = r"""#!/bin/bash
printf '%s\0' "$#" "${0##*/}" "$@" >> "$CALLS"
if [ "${0##*/} $1" = "ray exec" ]; then exec "$BASH" -e -c "${@: -1}"; fi
if [ "${0##*/} $1 $2" = "ray job submit" ]; then
    while [ "$1" != -- ]; do shift; done
    "${@:2}"
fi
"""
"""Records its name and arguments.  ``ray exec FILE COMMAND`` also runs COMMAND in a shell, as Ray does on the head, and
``ray job submit -- COMMAND`` calls COMMAND with its arguments."""

_PROGRAMS = (
    *("icrl-dist", "ray", "make", "git", "pip", "python", "python3", "python3.11", "ssh", "ssh-copy-id", "rm", "cd"),
    *("sbatch", "scancel", "sudo", "systemctl", "journalctl", "kubectl"),
    *("aws", "gcloud", "openssl", "head", "nohup", "jq", "du", "deploy/zenoh/certificates.sh", ".venv/bin/python"),
)


class Command(NamedTuple):
    """A command or block of commands in a text."""

    line: int
    text: str


class ShellError(Exception):
    """The shell ended with an error; the message holds the command and what the shell printed."""


def filled(text: str) -> str:
    """The text with a value in place of every placeholder."""
    longest_first = sorted(PLACEHOLDERS, key=len, reverse=True)
    pattern = "|".join(rf"(?<![\w$]){re.escape(name)}(?!\w)" for name in longest_first)
    return re.sub(pattern, lambda found: PLACEHOLDERS[found[0]], text)


def blocks(text: str) -> list[Command]:
    """The blocks of commands in a page: fenced as ``sh``, or indented by four spaces after an empty line."""
    found: list[Command] = []
    lines = text.splitlines()
    fence, start = "", 0
    for number, line in enumerate(lines):
        opened = re.match(r"\s*```(\w*)$", line)
        if opened and not fence:
            fence, start = opened[1] or "?", number + 1
        elif opened:
            if fence == "sh":
                found.append(Command(start + 1, "\n".join(lines[start:number])))
            fence = ""
        elif not fence and line.startswith("    ") and not lines[number - 1].strip() and not _in_list(lines[:number]):
            after = [n for n in range(number, len(lines)) if lines[n].strip() and not lines[n].startswith("    ")]
            block = lines[number : after[0] if after else len(lines)]
            found.append(Command(number + 1, "\n".join(row[4:] for row in block)))
    return found


def _in_list(before: Sequence[str]) -> bool:
    outer = [line for line in before if line.strip() and not line.startswith(" ")]
    return bool(outer) and re.match(r"([-*]|\d+\.) ", outer[-1]) is not None


def spans(text: str) -> list[Command]:
    """The code spans of a page or of docstrings that begin with ``icrl-dist`` and a space, outside of fenced blocks."""
    without_fences = re.sub(r"(?ms)^\s*```.*?^\s*```$", lambda block: "\n" * block[0].count("\n"), text)
    found = re.finditer(r"(`+)(icrl-dist [^`]+)\1", without_fences)
    return [Command(without_fences.count("\n", 0, span.start()) + 1, span[2].replace("\\|", "|")) for span in found]


def comments(text: str) -> str:
    """The comments of a YAML file as a page, in which lines indented by three spaces or more are blocks."""
    lines = [re.sub(r"^# ?", "", line) if line.startswith("#") else "" for line in text.splitlines()]
    return "\n".join(re.sub(r"^  (?= *\S)", "    ", line) for line in lines)


def calls(command: str, folder: Path) -> list[list[str]]:
    """The programs that bash calls for a command, each with its arguments, in an empty home folder.

    Raises ShellError if bash or a program that it looks for fails.
    """
    home, programs = folder / "home", folder / "programs"
    shutil.rmtree(home, ignore_errors=True)
    for name in _PROGRAMS:
        for place in (programs, home) if "/" in name else (programs,):
            (place / name).parent.mkdir(parents=True, exist_ok=True)
            (place / name).write_text(_STUB)
            (place / name).chmod(0o755)
    home.mkdir(exist_ok=True)
    activate = home / ".venv" / "bin" / "activate"
    activate.parent.mkdir(parents=True, exist_ok=True)
    activate.touch()
    record = folder / "calls"
    record.write_bytes(b"")
    environment = {"PATH": str(programs), "HOME": str(home), "CALLS": str(record), "USER": "ubuntu"}
    bash = shutil.which("bash", path=os.defpath) or "/bin/bash"
    script = f"set -e -o pipefail\n{command}\nwait\n"
    ended = subprocess.run([bash, "-c", script], cwd=home, env=environment, capture_output=True, text=True, timeout=20)
    if ended.returncode:
        raise ShellError(f"{command!r}: exit code {ended.returncode}, {ended.stderr.strip()}")
    words = record.read_bytes().decode().split("\0")[:-1]
    found = []
    while words:
        length = int(words[0])
        found.append(words[1 : length + 2])
        words = words[length + 2 :]
    return found
