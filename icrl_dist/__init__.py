"""Robust in-context reinforcement learning, distributed.

``load_agent`` loads a trained agent; ``make`` creates a variation environment to deploy it in;
``oracle`` computes exact solutions of Dark Room; ``read_results`` reads the returns of evaluations.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from icrl_dist.agent.in_context_agent import InContextAgent
    from icrl_dist.agent.loading import load_agent
    from icrl_dist.interfaces import Method, Problem
    from icrl_dist.problems.darkroom import solver as oracle
    from icrl_dist.problems.registry import make
    from icrl_dist.results.rows import read_results
    from icrl_dist.types import NULL, Adversary, Task, Variation

__version__ = "0.2.0"

__all__ = [
    "NULL",
    "Adversary",
    "InContextAgent",
    "Method",
    "Problem",
    "Task",
    "Variation",
    "load_agent",
    "make",
    "oracle",
    "read_results",
]

_MODULES = {
    "InContextAgent": "icrl_dist.agent.in_context_agent",
    "load_agent": "icrl_dist.agent.loading",
    "Method": "icrl_dist.interfaces",
    "Problem": "icrl_dist.interfaces",
    "make": "icrl_dist.problems.registry",
    "read_results": "icrl_dist.results.rows",
    "NULL": "icrl_dist.types",
    "Adversary": "icrl_dist.types",
    "Task": "icrl_dist.types",
    "Variation": "icrl_dist.types",
}


def __getattr__(name: str) -> object:
    """Import a public name at its first use, because most commands need no torch."""
    if name == "oracle":
        return importlib.import_module("icrl_dist.problems.darkroom.solver")
    if name in _MODULES:
        return getattr(importlib.import_module(_MODULES[name]), name)
    raise AttributeError(f"module 'icrl_dist' has no attribute {name!r}")
