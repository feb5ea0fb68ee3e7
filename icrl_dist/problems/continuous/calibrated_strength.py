"""Strengths of adversaries given as the loss that they cause: ``drop:0.25``, a quarter of the undisturbed expert's return.

Forces and displacements of different problems cannot be compared; relative losses of return can.  The strength
for a loss is measured once per problem (``icrl-dist bench disturbance --drop``) and stored in a table: the
package has one, and the user's own file, next to the cache of experts, is another.
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
_FIELDS = {"problem": str, "forces": list, "meters": float, "drop": float, "strength": float}
_METAWORLD = "metaworld"


def share(strength: str) -> float:
    """The share in (0, 1) of ``drop:SHARE``.  Raises ConfigError for any other text."""
    found = _FORM.fullmatch(strength)
    value = float(found[1]) if found else 0.0
    if not 0 < value < 1:
        raise ConfigError(
            f"control.strength = {strength!r}: write a number, or drop:SHARE, as in drop:0.25, where SHARE, above 0 and below "
            "1, is the share of its return that the undisturbed expert loses"
        )
    return value


def strength(control: ControlConfig, problem: str) -> float:
    """The number of ``control.strength``; that of a ``drop:SHARE`` is ``control.solved``, or in a table.

    Raises ConfigError for a drop that is not solved for this problem, with the remedy.
    """
    if isinstance(control.strength, float):
        return control.strength
    key, _, number = control.solved.partition("=")
    return float(number) if key == _key(control, problem) else _look_up(control, problem)


def resolved(control: ControlConfig, problem: str) -> ControlConfig:
    """The section with the number of a ``drop:SHARE`` in ``solved``, so that later changes of a table do not change the run."""
    if isinstance(control.strength, float):
        return dataclasses.replace(control, solved="") if control.solved else control
    return dataclasses.replace(control, solved=f"{_key(control, problem)}={strength(control, problem)!r}")


def _key(control: ControlConfig, problem: str) -> str:
    disturbance = f"{control.disturbance:g}" if problem.startswith(_METAWORLD) else control.forces
    return f"{problem}/{disturbance}/drop:{share(str(control.strength)):g}"


def _look_up(control: ControlConfig, problem: str) -> float:
    wanted, by_force = share(str(control.strength)), not problem.startswith(_METAWORLD)
    rows = [row for row in table() if row["problem"] == problem and (control.forces in row["forces"] or not by_force)]
    for row in rows:
        if row["drop"] == wanted:
            return float(row["strength"]) if by_force else float(row["strength"] * row["meters"] / control.disturbance)
    known = ", ".join(f"drop:{row['drop']:g}" for row in rows) or "none"
    setting = f"{problem} with forces of {control.forces!r}" if by_force else problem
    raise ConfigError(
        f"control.strength = {control.strength!r}: not solved for {setting} (solved: {known}); give a number, or measure it "
        f"with `icrl-dist bench disturbance --problem {problem} --drop {wanted:g}`"
    )


def own_file() -> Path:
    """The file with the user's own measurements.  Raises ConfigError if this user has no home folder."""
    try:
        return Path(SACConfig().cache).expanduser().parent / "drops.json"
    except RuntimeError:
        raise ConfigError("bench disturbance --drop: this user has no home folder to keep the result in: set HOME") from None


def packaged() -> list[dict[str, Any]]:
    """The measured strengths in the package."""
    return _rows(
        (resources.files("icrl_dist.problems.continuous") / "calibrated_strengths.json").read_text(encoding="utf-8"),
        "icrl_dist/problems/continuous/calibrated_strengths.json",
    )


def table() -> list[dict[str, Any]]:
    """All measured strengths.  Those of the package come first, so that a run file has the same meaning everywhere.

    Raises ConfigError if the user's file is damaged.
    """
    return packaged() + own()


def own() -> list[dict[str, Any]]:
    """The user's own measurements.  Raises ConfigError for a damaged file."""
    try:
        file = own_file()
    except ConfigError:  # without a home folder there are none
        return []
    try:
        return _rows(file.read_text(encoding="utf-8"), str(file)) if file.exists() else []
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigError(f"{file}: cannot be read ({error}); delete it and measure its strengths again") from None


def _rows(text: str, source: str) -> list[dict[str, Any]]:
    try:
        rows = json.loads(text)
        former = any("metres" in row for row in rows)
        good = former or all(isinstance(row[name], kind) for row in rows for name, kind in _FIELDS.items())
    except (ValueError, KeyError, TypeError) as error:
        raise ConfigError(
            f"{source}: not a table of calibrated strengths ({error!r}); delete it and measure them again"
        ) from None
    if former:
        raise ConfigError(f"{source}: metres is now called meters: rename it")
    if not isinstance(rows, list) or not good or any(not 0 < row["strength"] < float("inf") for row in rows):
        raise ConfigError(f"{source}: not a table of calibrated strengths; delete it and measure them again")
    return rows
