"""What made a run: its code, libraries and machine, for ``env.json``, checkpoints, agents and result rows.

``record`` is the only source of it; docs/run-folder.md explains the entries.
"""

from __future__ import annotations

import functools
import json
import os
import platform
import subprocess
from collections.abc import Iterator, Mapping
from datetime import UTC, datetime
from importlib import metadata
from pathlib import Path
from typing import Any

from icrl_dist import __version__, version
from icrl_dist.config import plugins
from icrl_dist.config.sections import Reproducible
from icrl_dist.storage.files import write_json

LIBRARIES = (
    *("torch", "numpy", "scipy", "gymnasium", "mujoco", "dm-control", "metaworld", "stable-baselines3"),
    *("ray", "eclipse-zenoh", "msgpack"),
)
"""Distributions whose versions are recorded for every run, besides those of its problem (``Problem.libraries``)."""

FILE = "env.json"
"""File of a run folder with one record per session; a session is one start of the learner."""

_ANY_MACHINE = frozenset({"torch", "instruction set", "processor", "threads"})
"""Names in a comparison that change no byte of a run with ``any_machine``."""
_COMPARED = ("package_version", "code_digest", "libraries", "plugins", "instruction_set", "processor", "threads", "device")
"""Entries that can change the bytes of a run.  The commit is left out because the code digest states the same."""


def record(
    problem: str, method: str, threads: int, device: str = "cpu", reproducible: Reproducible = "this-machine"
) -> dict[str, Any]:
    """What makes the results of this process, as JSON values.

    ``threads``: CPU threads of a fit; ``device``: ``cpu``, or the name of the GPU; ``reproducible``: of the run's learner.
    """
    import torch

    found = plugins.sources()
    return {
        "package_version": __version__,
        "code_digest": version.digest(),
        "commit": commit(),
        "libraries": dict(_libraries(problem)),
        "plugins": {name: found[name]._asdict() for name in plugins.of_run(problem, method) if name in found},
        "instruction_set": torch.backends.cpu.get_cpu_capability(),
        "processor": processor(),
        "platform": platform.platform(),
        "threads": threads,
        "device": device,
        # Simulators of other packages may depend on the processor, however the fits are made.
        "any_machine": reproducible == "any-machine" and not plugins.find("problems", problem).libraries,
    }


@functools.cache
def _libraries(problem: str) -> dict[str, str]:
    """The versions of Python and of the libraries, by name; without those that are not installed."""
    found = {"python": platform.python_version()}
    for name in dict.fromkeys((*LIBRARIES, *plugins.find("problems", problem).libraries)):
        try:
            found[name] = metadata.version(name)
        except metadata.PackageNotFoundError:
            continue
    return found


@functools.cache
def commit(root: Path = Path(__file__).parents[2]) -> str:
    """The Git commit of the code in ``root``, followed by ``-dirty`` if the code was changed since.

    Empty if ``root`` is no Git checkout, or if it cannot be read with ``git``.
    """
    if not (root / ".git").exists():  # a checkout around an installed package is another project's
        return ""
    command = ["git", "--no-optional-locks", "-C", str(root), "status", "--porcelain=v2", "--branch", "--", *version.PACKAGES]
    environment = {name: value for name, value in os.environ.items() if not name.startswith("GIT_")}  # a hook's
    try:
        ran = subprocess.run(command, capture_output=True, text=True, timeout=10, check=True, env=environment)
    except (OSError, subprocess.SubprocessError):
        return ""
    lines = ran.stdout.splitlines()
    found = next((line.split()[2] for line in lines if line.startswith("# branch.oid ")), "(initial)")
    changed = any(not line.startswith("#") for line in lines)
    return "" if found == "(initial)" else found + "-dirty" * changed


@functools.cache
def processor(cpuinfo: Path = Path("/proc/cpuinfo")) -> str:
    """The name of the processor; its architecture if it has no name there, as on some ARM machines."""
    try:
        lines = cpuinfo.read_text().splitlines()
    except OSError:
        lines = []
    names = (line.partition(":")[2].strip() for line in lines if line.startswith("model name"))
    return next(names, platform.machine())


def sessions(folder: Path) -> list[dict[str, Any]]:
    """The records of a run's sessions, oldest first; empty if ``env.json`` is missing or damaged."""
    return _read(folder) or []


def readable(folder: Path) -> bool:
    """Whether ``env.json`` holds records of sessions, or none of them yet."""
    return _read(folder) is not None


def _read(folder: Path) -> list[dict[str, Any]] | None:
    try:
        found = json.loads((folder / FILE).read_text())
        if "versions" in found:  # version 0.1.0 wrote one record, with other names
            versions = dict(found["versions"])
            package = versions.pop("icrl-dist", "")
            others = {name: found[name] for name in ("platform", "cores") if name in found}
            return [{"package_version": package, "libraries": {"python": found.get("python", ""), **versions}, **others}]
        return [dict(one) for one in found["sessions"]]
    except (OSError, ValueError, TypeError, AttributeError, KeyError):
        return None


def create(folder: Path) -> None:
    """Write ``env.json`` of a new run, without sessions; keep the file of a run that continues."""
    if not (folder / FILE).exists():
        _write(folder, [])


def add_session(folder: Path, policy_version: int, made_by: Mapping[str, Any]) -> str:
    """Add a session that begins now, at this policy version, to ``env.json``.

    Returns how its record differs from the one that the run began with, or that the file was damaged, as one line for the
    user; empty if there is nothing to say.
    Raises StoreError if the file cannot be written.
    """
    damaged = (folder / FILE).exists() and not readable(folder)
    before = sessions(folder)
    began = {"began": datetime.now(UTC).isoformat(timespec="seconds"), "policy_version": policy_version}
    _write(folder, [*before, {**began, "cores": len(os.sched_getaffinity(0)), **made_by}])
    if damaged:
        return f"{folder / FILE}: was damaged, so its earlier sessions are lost; it is written anew"
    changed = differences(before[0], made_by) if before else ""
    return f"this run began with {changed}: digests can differ from those of an uninterrupted run" if changed else ""


def _write(folder: Path, records: list[dict[str, Any]]) -> None:
    write_json(folder / FILE, {"sessions": records})


def differences(then: Mapping[str, Any], now: Mapping[str, Any]) -> str:
    """Entries that differ between two records and can change bytes, as text; entries that only one has do not count."""
    old, new = dict(_flat(then)), dict(_flat(now))
    free = _ANY_MACHINE if then.get("any_machine") and now.get("any_machine") else frozenset[str]()
    compared = [name for name in old if name in new and name not in free]
    return ", ".join(f"{name} {old[name]} (now {new[name]})" for name in compared if old[name] != new[name])


def _flat(record: Mapping[str, Any]) -> Iterator[tuple[str, str]]:
    """The compared entries of a record as texts; libraries and plugins have one each."""
    for name in _COMPARED:
        value = record.get(name)
        if name == "code_digest" and value:
            yield "code", str(value)[:8]
        elif name == "plugins":
            yield from ((key, plugins.text(list(source.values()))) for key, source in (value or {}).items())
        elif name == "libraries":
            yield from ((key, str(found)) for key, found in (value or {}).items())
        elif value is not None:
            yield {"package_version": "icrl-dist", "instruction_set": "instruction set"}.get(name, name), str(value)


def text(made_by: Mapping[str, Any]) -> str:
    """A record in one line."""
    code, commit = made_by.get("code_digest", "")[:8], made_by.get("commit", "")
    parts = [f"icrl-dist {made_by.get('package_version', '')}", f"code {code}" if code else ""]
    parts.append(f"commit {commit[:8]}{'-dirty' * commit.endswith('-dirty')}" if commit else "")
    parts += [f"{name} {made_by.get('libraries', {}).get(name, 'unknown')}" for name in ("python", "torch", "numpy")]
    parts.append(made_by.get("instruction_set", ""))
    parts.append(f"threads {made_by['threads']}" if "threads" in made_by else "")
    parts.append("the same bytes on any machine" if made_by.get("any_machine") else "")
    return ", ".join(part for part in parts if part)
