"""MuJoCo, also where the renderer that MUJOCO_GL names is not there: nothing is drawn in a training.

MuJoCo and dm_control load the renderer when they are imported, and fail then if it is missing.  Modules of this package
import MuJoCo from here, and dm_control through ``imported``.
"""

from __future__ import annotations

import importlib
import os
from typing import Any

OFF = ("", "disabled", "disable", "off", "false", "0")
"""Values of MUJOCO_GL without a renderer."""
missing: list[str] = []
"""Why the renderer that the user named cannot be used: ``MUJOCO_GL=NAME`` and the error, once one was tried."""


def imported(name: str) -> Any:
    """The module of this name, which loads a renderer; without one (MUJOCO_GL=disabled) if that cannot be loaded."""
    try:
        return importlib.import_module(name)
    except Exception as error:  # each renderer raises its own type
        asked = os.environ.get("MUJOCO_GL", "")
        if asked in OFF:
            raise
        missing.append(f"MUJOCO_GL={asked}: {' '.join(str(error).split())}")
        os.environ["MUJOCO_GL"] = "disabled"
        return importlib.import_module(name)


imported("mujoco")
import mujoco as mujoco  # noqa: E402
