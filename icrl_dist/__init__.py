"""Robust in-context reinforcement learning, distributed.

``train`` trains a run, ``load_run`` reads one to change it, ``evaluate`` evaluates its agent, ``sweep`` does many runs;
``read_results`` reads the returns of evaluations, ``compare`` compares trainings, ``report`` makes figures and tables of
many, ``read_dataset`` reads the trajectories that a run collected.
``load_agent`` loads a trained agent; ``make`` creates a variation environment to deploy it in; ``oracle`` computes
exact solutions of Dark Room.  docs/python.md has an example of each.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from icrl_dist.agent.in_context_agent import InContextAgent
    from icrl_dist.agent.loading import load_agent
    from icrl_dist.config.run import ConfigError, Run, load_run
    from icrl_dist.interfaces import Method, Problem
    from icrl_dist.launch.learner_process import TrainFailed
    from icrl_dist.launch.train import TrainInterrupted
    from icrl_dist.launch.whole_run import TrainResult, train
    from icrl_dist.problems.darkroom import solver as oracle
    from icrl_dist.problems.registry import make
    from icrl_dist.results.paper_report import report
    from icrl_dist.results.reports import Evaluation
    from icrl_dist.results.rows import read_results
    from icrl_dist.results.suites import evaluate
    from icrl_dist.results.tables import compare
    from icrl_dist.storage.files import StoreError
    from icrl_dist.storage.reading import StoredData, read_dataset
    from icrl_dist.sweeps.sweep import SweepResult, sweep
    from icrl_dist.types import NULL, Adversary, Identity, Task, Trajectory, Variation

__version__ = "0.2.0"

__all__ = [
    "NULL",
    "Adversary",
    "ConfigError",
    "Evaluation",
    "Identity",
    "InContextAgent",
    "Method",
    "Problem",
    "Run",
    "StoreError",
    "StoredData",
    "SweepResult",
    "Task",
    "TrainFailed",
    "TrainInterrupted",
    "TrainResult",
    "Trajectory",
    "Variation",
    "compare",
    "evaluate",
    "load_agent",
    "load_run",
    "make",
    "oracle",
    "read_dataset",
    "read_results",
    "report",
    "sweep",
    "train",
]

_MODULES = {
    "InContextAgent": "icrl_dist.agent.in_context_agent",
    "load_agent": "icrl_dist.agent.loading",
    "ConfigError": "icrl_dist.config.run",
    "Run": "icrl_dist.config.run",
    "load_run": "icrl_dist.config.run",
    "Method": "icrl_dist.interfaces",
    "Problem": "icrl_dist.interfaces",
    "TrainFailed": "icrl_dist.launch.learner_process",
    "TrainInterrupted": "icrl_dist.launch.train",
    "TrainResult": "icrl_dist.launch.whole_run",
    "train": "icrl_dist.launch.whole_run",
    "make": "icrl_dist.problems.registry",
    "Evaluation": "icrl_dist.results.reports",
    "report": "icrl_dist.results.paper_report",
    "read_results": "icrl_dist.results.rows",
    "evaluate": "icrl_dist.results.suites",
    "compare": "icrl_dist.results.tables",
    "StoreError": "icrl_dist.storage.files",
    "StoredData": "icrl_dist.storage.reading",
    "read_dataset": "icrl_dist.storage.reading",
    "SweepResult": "icrl_dist.sweeps.sweep",
    "sweep": "icrl_dist.sweeps.sweep",
    "NULL": "icrl_dist.types",
    "Adversary": "icrl_dist.types",
    "Identity": "icrl_dist.types",
    "Task": "icrl_dist.types",
    "Trajectory": "icrl_dist.types",
    "Variation": "icrl_dist.types",
}

_COMPUTE = ("evaluate",)
"""Names whose modules import torch, and that compute in this process; others import torch when they need it."""


def __getattr__(name: str) -> object:
    """Import a public name at its first use, because most commands need no torch."""
    if name == "oracle":
        return importlib.import_module("icrl_dist.problems.darkroom.solver")
    if name in _MODULES:
        if name in _COMPUTE:
            importlib.import_module("icrl_dist.telemetry.processes").import_torch()
        try:
            return getattr(importlib.import_module(_MODULES[name]), name)
        except ImportError as error:
            modules = importlib.import_module("icrl_dist.diagnostics.modules")
            for package, file in modules.hidden_packages().items():
                raise ImportError(f"{file} hides the package {package!r}, a part of icrl-dist: rename that file") from error
            raise
    raise AttributeError(f"module 'icrl_dist' has no attribute {name!r}")
