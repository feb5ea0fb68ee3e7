"""The sweep file: its keys, and how it is read."""

from __future__ import annotations

import dataclasses
import re
import tomllib
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, Literal

from annotated_types import MinLen

from icrl_dist.config.paths import path_of
from icrl_dist.config.ranges import NotNegativeFloat, Positive, Seed
from icrl_dist.config.run import ConfigError, Deployment
from icrl_dist.config.toml import build, nearest
from icrl_dist.results.suite_numbers import DRAWS
from icrl_dist.stream.excerpts import show
from icrl_dist.stream.schema import Remedy

EXACT = "exact"
"""The pseudo-method that trains nothing: only the reference agents of the problem are evaluated."""
TRAINING = "training"
"""In collected rows the evaluation of those that the training wrote itself (suite ``label_quality``)."""
_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]{0,59}")


@dataclass(frozen=True)
class Only:
    """``only = {...}``: what a method or an evaluation is limited to.  A key that is left out is no limit."""

    settings: tuple[str, ...] = ()
    """Names of settings."""
    methods: tuple[str, ...] = ()
    """Names of methods of this file; of an evaluation only."""
    seeds: tuple[Seed, ...] = ()
    """Training seeds, in place of ``seeds`` of the file; of a method only."""


@dataclass(frozen=True)
class Evaluation:
    """``[evaluations.NAME]``: an evaluation of every run after its training.  Left out: the number of the run file."""

    suite: Literal["online", "offline", "posterior", "attack"] = "online"
    """As ``icrl-dist evaluate --suite``."""
    deploy: Deployment | None = None
    """The deployment rule; left out: the one that the model was trained for."""
    episodes: int | None = None
    """``evaluate.episodes``."""
    seeds: int | None = None
    """``evaluate.seeds``: evaluations of each task, not training seeds."""
    p: tuple[float, ...] | None = None
    """``evaluate.p``."""
    prior: Literal["uniform", "unseen"] | None = None
    """``evaluate.prior``."""
    draws: Positive = DRAWS
    """Sampled adversaries of suite ``attack``."""
    rounds: bool = False
    """Whether the models between T^0 and the newest one are evaluated too."""
    only: Only = field(default_factory=Only)
    """Settings and methods that are evaluated so."""

    def overrides(self) -> dict[str, Any]:
        """The keys of ``[evaluate]`` that it names."""
        named = {name: getattr(self, name) for name in ("episodes", "seeds", "p", "prior")}
        return {name: value for name, value in named.items() if value is not None}


@dataclass(frozen=True)
class Equal:
    """``[equal]``: by how much budgets may differ between the methods of one setting, and what is not compared."""

    environment_steps: NotNegativeFloat = 0.0
    """Greatest difference of the environment steps of trainings, as a share of the largest."""
    labelled_episodes: NotNegativeFloat = 0.0
    """The same of the episodes whose labels the fits use; 1 allows any number."""
    optimizer_steps: NotNegativeFloat = 0.0
    """The same of optimizer steps."""
    seeds: bool = True
    """Whether all methods of a setting have the same training seeds."""
    methods: tuple[str, ...] = ()
    """Methods that are compared with no other one on purpose."""
    reason: str = ""
    """Why they are not."""


@dataclass(frozen=True)
class SweepFile:
    """A sweep: every method in every setting with every training seed."""

    run: str
    """Packaged run, or path of a run file (from the folder of the sweep file), that all runs are made from."""
    seeds: Annotated[tuple[Seed, ...], MinLen(1), Remedy("name at least one training seed")]
    """Training seeds."""
    settings: dict[str, Any]
    """``[settings.NAME]``: keys of the run file that this setting changes."""
    methods: dict[str, Any]
    """``[methods.NAME]``: ``method`` and further keys of the run file; ``method = "exact"`` trains nothing."""
    evaluations: dict[str, Any]
    """``[evaluations.NAME]``: what is evaluated in every run; each an ``Evaluation``."""
    split_seed: str | int | None = None
    """``"seed"``: the split into training and test tasks has the training seed; or a number.  Left out: the run's."""
    equal: Equal = field(default_factory=Equal)
    """``[equal]``."""


def read(file: str | Path) -> SweepFile:
    """Read a sweep file.  Raises ConfigError for an unknown key, an empty list and a wrong name, each in one line."""
    path = path_of("FILE", file)
    try:
        tables = tomllib.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise ConfigError(f"sweep file {str(path)!r}: cannot be read ({error.strerror}); name a TOML file") from None
    except (ValueError, RecursionError) as error:
        raise ConfigError(f"{path}: not valid TOML: {' '.join(str(error).split())}") from None
    found = build(SweepFile, tables, str(path))
    assert isinstance(found, SweepFile)
    _check(found, str(path))
    evaluations = {name: build(Evaluation, one, f"{path}: [evaluations.{name}]") for name, one in found.evaluations.items()}
    found = dataclasses.replace(found, evaluations=evaluations)
    _check_names(found, str(path))
    return found


def _check(sweep: SweepFile, source: str) -> None:
    if not sweep.run.strip():
        raise ConfigError(
            f'{source}: run = {show(sweep.run)}: names no run; name a packaged one, as in run = "demo", or a file'
        )
    if sweep.split_seed not in ("seed", None) and not isinstance(sweep.split_seed, int):
        raise ConfigError(f'{source}: split_seed = {show(sweep.split_seed)}: use "seed", a number, or leave it out')
    for kind in ("settings", "methods", "evaluations"):
        named = getattr(sweep, kind)
        if not named:
            raise ConfigError(f"{source}: [{kind}] is empty; name at least one, as in [{kind}.NAME]")
        for name, value in named.items():
            if not _NAME.fullmatch(name):
                raise ConfigError(
                    f"{source}: [{kind}.{show(name)}]: use letters, digits and . _ - in a name, at most 60; begin with a "
                    "letter or a digit"
                )
            if not isinstance(value, dict):
                raise ConfigError(f"{source}: {kind}.{name} = {show(value)}: expected a table, as in [{kind}.{name}]")


def _check_names(sweep: SweepFile, source: str) -> None:
    if TRAINING in sweep.evaluations:
        raise ConfigError(f"{source}: [evaluations.{TRAINING}]: rows of the training have this name; choose another")
    for name, one in sweep.evaluations.items():
        where = f"{source}: [evaluations.{name}] only"
        known(one.only.settings, sweep.settings, f"{where}.settings")
        known(one.only.methods, sweep.methods, f"{where}.methods")
        if one.only.seeds:
            raise ConfigError(f"{where}.seeds: an evaluation is not limited to training seeds; limit a method")
    known(sweep.equal.methods, sweep.methods, f"{source}: [equal] methods")
    if sweep.equal.methods and not sweep.equal.reason.strip():
        raise ConfigError(f"{source}: [equal] methods: say in reason why they are compared with no other method")


def known(names: tuple[str, ...], there: dict[str, Any], where: str) -> None:
    """Raises ConfigError, with the nearest name, for a name that is not ``there``."""
    for name in names:
        if name not in there:
            raise ConfigError(f"{where}: no {show(name)}{nearest(name, list(there))}; there are {', '.join(there)}")
