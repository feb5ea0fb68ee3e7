"""Strengths that are given by what they take: ``drop:0.25``, a quarter of the undisturbed expert's return.

Newtons and metres do not compare; shares of a return do.  Which strength takes which share is measured once a
problem (``icrl-dist bench disturbance --drop``) and kept: in the package, and in the user's own file beside
the cache of experts.
"""

from __future__ import annotations

import dataclasses
import json
import re
from importlib import resources
from pathlib import Path
from typing import Any

from icrl_dist.config.sac import SACConfig
from icrl_dist.config.toml import ConfigError
from icrl_dist.problems.continuous.config import ControlConfig

_FORM = re.compile(r"drop:(0?\.\d+|\d+e-\d+)")
_FIELDS = {"problem": str, "forces": list, "metres": float, "drop": float, "strength": float}
_METAWORLD = "metaworld"


def share(strength: str) -> float:
    """The share in (0, 1) that ``drop:SHARE`` names.  Raises ConfigError for anything else."""
    found = _FORM.fullmatch(strength)
    value = float(found[1]) if found else 0.0
    if not 0 < value < 1:
        raise ConfigError(
            f"control.strength = {strength!r}: write a number, or drop:SHARE, as in drop:0.25: the share of the undisturbed "
            "expert's return that is to be lost, above 0 and below 1"
        )
    return value


def strength(control: ControlConfig, problem: str) -> float:
    """The strength of an adversary of 1: ``control.strength``, or what its drop comes to.

    Raises ConfigError for a drop that is not solved for this problem, with the remedy.
    """
    if isinstance(control.strength, float):
        return control.strength
    key, _, number = control.solved.partition("=")
    return float(number) if key == _key(control, problem) else _looked_up(control, problem)


def resolved(control: ControlConfig, problem: str) -> ControlConfig:
    """The section with what its drop comes to written beside it, so that no later table changes the run."""
    if isinstance(control.strength, float):
        return dataclasses.replace(control, solved="") if control.solved else control
    return dataclasses.replace(control, solved=f"{_key(control, problem)}={strength(control, problem)!r}")


def _key(control: ControlConfig, problem: str) -> str:
    of = f"{control.disturbance:g}" if problem.startswith(_METAWORLD) else control.forces
    return f"{problem}/{of}/drop:{share(str(control.strength)):g}"


def _looked_up(control: ControlConfig, problem: str) -> float:
    wanted, simulated = share(str(control.strength)), not problem.startswith(_METAWORLD)
    rows = [row for row in table() if row["problem"] == problem and (control.forces in row["forces"] or not simulated)]
    for row in rows:
        if row["drop"] == wanted:
            return float(row["strength"]) if simulated else float(row["strength"] * row["metres"] / control.disturbance)
    known = ", ".join(f"drop:{row['drop']:g}" for row in rows) or "none"
    of = f"{problem} with forces of {control.forces!r}" if simulated else problem
    raise ConfigError(
        f"control.strength = {control.strength!r}: not solved for {of} (solved: {known}); give a number, or measure it with "
        f"`icrl-dist bench disturbance --problem {problem} --drop {wanted:g}`"
    )


def own_file() -> Path:
    """Where this user's own measurements are kept."""
    return Path(SACConfig().cache).expanduser().parent / "drops.json"


def packaged() -> list[dict[str, Any]]:
    """What comes with the package."""
    return _rows(
        (resources.files("icrl_dist.problems.continuous") / "calibrated_strengths.json").read_text(encoding="utf-8"),
        "icrl_dist/problems/continuous/calibrated_strengths.json",
    )


def table() -> list[dict[str, Any]]:
    """Every measured strength, the package's first: a run file means the same everywhere.

    Raises ConfigError for a file of the user's that is damaged.
    """
    return packaged() + own()


def own() -> list[dict[str, Any]]:
    """This user's own measurements.  Raises ConfigError for a damaged file."""
    file = own_file()
    try:
        return _rows(file.read_text(encoding="utf-8"), str(file)) if file.exists() else []
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigError(f"{file}: cannot be read ({error}); delete it, and solve anew what it held") from None


def _rows(text: str, source: str) -> list[dict[str, Any]]:
    try:
        rows = json.loads(text)
        good = all(isinstance(row[name], kind) for row in rows for name, kind in _FIELDS.items())
    except (ValueError, KeyError, TypeError) as error:
        raise ConfigError(
            f"{source}: not a table of calibrated strengths ({error!r}); delete it, and solve anew what it held"
        ) from None
    if not isinstance(rows, list) or not good or any(not 0 < row["strength"] < float("inf") for row in rows):
        raise ConfigError(f"{source}: not a table of calibrated strengths; delete it, and solve anew what it held")
    return rows
