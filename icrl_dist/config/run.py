"""The run file: all settings of a run, and how they are read.

A run file is TOML with one table per section.  ``load`` reads it strictly: an unknown key, a wrong
type or an impossible value raises ConfigError.  Command line options override it.  The problem and
the methods may add sections.  A function takes the section that it needs; it takes the whole ``Run``
only if it needs many sections.
"""

from __future__ import annotations

import dataclasses
import functools
import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from importlib import resources
from pathlib import Path
from typing import Any, Self, cast

from icrl_dist.config import former_names, plugins
from icrl_dist.config.paths import path_of
from icrl_dist.config.ranges import Seed
from icrl_dist.config.sac import SACConfig
from icrl_dist.config.sections import (
    AdversaryConfig,
    AlertsConfig,
    ContextConfig,
    DAggerConfig,
    Deployment,
    EvaluateConfig,
    ICAAConfig,
    LearnerConfig,
    ModelConfig,
    OptimConfig,
    PretrainConfig,
    StreamConfig,
)
from icrl_dist.config.toml import ConfigError, build, dumps, nearest
from icrl_dist.config.validation import validate

__all__ = [
    "ConfigError",
    "Deployment",
    "Run",
    "dumps",
    "load",
    "load_folder",
    "load_run",
    "override",
    "parse",
    "parse_written",
    "run_folder_of",
    "validate",
]


@dataclass(frozen=True)
class Run:
    """The settings of one run."""

    method: str = "icag"
    """Method that trains the transformer: ``icag`` or ``icaa`` of section 4, or a baseline (``dpt``; ``mix_dpt``, which goes
    on with its own histories; ``dr``, domain randomisation; ``ic2rl``, labels of robust policies; ``prompt_dt`` and
    ``ardt``, decision transformers; ``ad``, Algorithm Distillation).  ``experts`` trains no transformer: it only trains
    and stores the SAC experts of a continuous problem, for later runs."""
    seed: Seed = 0
    """Seed of every random draw of the run."""
    problem: str = "darkroom"
    """``darkroom``, ``metaworld-pick-place``, or a problem of DeepMind Control such as ``dmc-cheetah-run``."""
    sac: SACConfig = field(default_factory=SACConfig)
    adversary: AdversaryConfig = field(default_factory=AdversaryConfig)
    pretrain: PretrainConfig = field(default_factory=PretrainConfig)
    dagger: DAggerConfig = field(default_factory=DAggerConfig)
    icaa: ICAAConfig = field(default_factory=ICAAConfig)
    model: ModelConfig = field(default_factory=ModelConfig)
    optim: OptimConfig = field(default_factory=OptimConfig)
    context: ContextConfig = field(default_factory=ContextConfig)
    evaluate: EvaluateConfig = field(default_factory=EvaluateConfig)
    stream: StreamConfig = field(default_factory=StreamConfig)
    learner: LearnerConfig = field(default_factory=LearnerConfig)
    alerts: AlertsConfig = field(default_factory=AlertsConfig)

    def __reduce__(self) -> tuple[Any, ...]:
        """By the settings, because a class that ``run_type`` makes has no name of its own by which pickle could find it."""
        settings = {name: getattr(self, name) for name in names_of(type(self))}
        return _remade, (type(self) is Run, settings)

    def __deepcopy__(self, memo: object) -> Self:
        return self  # a run and its sections cannot change

    def section(self, name: str) -> Any:
        """The section of this name; sections of the problem and of methods are included."""
        return getattr(self, name)


def _remade(without_sections: bool, settings: dict[str, Any]) -> Run:
    return (Run if without_sections else run_type(settings["problem"]))(**settings)


def run_type(problem: str | None) -> type[Run]:
    """``Run`` with the sections of this problem (with None, of all problems) and of the installed methods.

    Equal sections give the same class, so that runs are equal if their settings are.  Raises ConfigError
    for a problem that is not installed.
    """
    return _run_type(tuple(plugins.sections(problem).items()))


@functools.cache
def _run_type(sections: tuple[tuple[str, type], ...]) -> type[Run]:
    added = [(name, kind, field(default_factory=kind)) for name, kind in sections]
    made = dataclasses.make_dataclass("Run", added, bases=(Run,), frozen=True, namespace={"__doc__": Run.__doc__})
    made.__module__ = __name__
    return cast(type[Run], made)


def make_run(problem: str = "darkroom", **fields: Any) -> Run:
    """A run of this problem; ``fields``: its other settings, which may include the problem's section."""
    return run_type(problem)(problem=problem, **fields)


def load(name_or_path: str) -> Run:
    """Read the packaged run file of this name, or the one at this path; ``experts-NAME``: with method ``experts``.

    The ``run.toml`` of a run folder is read as by ``load_folder``.  Raises ConfigError if there is no such file, or
    if a key or value in it is impossible.
    """
    if name_or_path.startswith("experts-"):
        return replace(load(name_or_path.removeprefix("experts-")), method="experts")
    path = Path(name_or_path)
    if path.suffix == ".toml" or "/" in name_or_path or run_folder_of(name_or_path) is not None:
        written = path.name == _RUN_FILE and (path.parent / "env.json").is_file()  # the program writes both
        return (parse_written if written else parse)(_text(path, name_or_path), name_or_path)
    runs = _packaged()
    if name_or_path not in runs:
        raise ConfigError(
            f"run {name_or_path!r}: no packaged run of that name{nearest(name_or_path, list(runs))}; "
            f"there are {', '.join(runs)}; a path must end in .toml"
        )
    file, problem = runs[name_or_path]
    text = (resources.files("icrl_dist.config.runs") / f"{file}.toml").read_text(encoding="utf-8")
    return parse(f'problem = "{problem}"\n{text}' if problem else text, name_or_path)


def load_run(what: str | Path, *settings: str) -> Run:
    """A run to change and train: ``load_run("smoke", "icaa.rounds=2", "seed=3")``.

    ``what``: the name of a packaged run, the path of a run file, or that of a run folder (a ``Path``, or text with a
    "/").  ``settings``: SECTION.NAME=VALUE, or NAME=VALUE for ``seed``, ``method`` and ``problem``.
    ``dataclasses.replace(run, seed=3)`` changes a run too; ``icrl_dist.train`` checks it.
    Raises ConfigError, with the nearest name, for an unknown run or key, and for an impossible value.
    """
    path = path_of("what", what)
    is_path = not isinstance(what, str) or "/" in what
    run = load_folder(path) if is_path and path.is_dir() else load(str(path) if is_path else str(what))
    return override(run, settings, str(what))


_RUN_FILE = "run.toml"
_FORMER: Mapping[str, Mapping[str, str]] = {"context": {"decoder": "torch"}, "learner": {"reproducible": "this-machine"}}
"""The values of keys, by section, in files of versions without the keys: what these versions did."""


def load_folder(folder: Path) -> Run:
    """The settings of the run in a folder; an older version may have written them, see ``parse_written``.

    Raises ConfigError if the folder holds no run, or if its settings cannot be read.
    """
    path = folder / _RUN_FILE
    return parse_written(_text(path, str(path)), str(path))


def run_folder_of(what: str | Path) -> Path | None:
    """The run folder that RUN names: ``runs/demo`` or ``runs/demo/run.toml``; None if it names a run file or a packaged run."""
    if not str(what) or str(what) in _packaged():
        return None
    path = Path(what)
    if (path / _RUN_FILE).is_file():
        return path
    return path.parent if path.name == _RUN_FILE and (path.parent / "env.json").is_file() else None


def _text(path: Path, name: str) -> str:
    if (path / _RUN_FILE).is_file():
        raise ConfigError(f"{name} is a run folder: `icrl-dist train --resume {name}` continues its run")
    if not path.is_file():
        raise ConfigError(f"run file {name!r}: no such file")
    try:
        return path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigError(f"run file {name!r}: cannot be read: {error}") from None


def packaged_runs() -> list[str]:
    """The names that ``load`` accepts."""
    return list(_packaged())


@functools.cache
def _packaged() -> dict[str, tuple[str, str]]:
    """For each name its file, and its problem if several problems share the file (else an empty string)."""
    files = {file.name.removesuffix(".toml") for file in resources.files("icrl_dist.config.runs").iterdir()}
    templates = {name: problem.template for name, problem in plugins.importable("problems").items()}
    shared = {
        f"{name}{size}": (f"{template}{size}", name)
        for name, template in templates.items()
        for size in ("", "-laptop")
        if template and f"{template}{size}" in files
    }
    unshared = files - {file for file, _ in shared.values()} - {"__init__.py", "__pycache__"}
    return dict(sorted({**shared, **{name: (name, "") for name in unshared}}.items()))


def parse(text: str, source: str) -> Run:
    """The run that TOML ``text`` of a user describes.  Raises ConfigError with ``source`` and the key."""
    return _from_tables(_tables(text, source), source)


def parse_written(text: str, source: str) -> Run:
    """The run in a text that this program wrote, in this version or an older one.

    Former names and values are translated, and sections of other problems are left out.  Raises ConfigError with
    ``source`` and the key.
    """
    return _from_tables(_tables(text, source), source, written=True)


def _tables(text: str, source: str) -> dict[str, Any]:
    try:
        return tomllib.loads(text)
    except (ValueError, RecursionError) as error:  # also a number or a nesting beyond Python's limits
        raise ConfigError(f"{source}: not valid TOML: {error}") from None


def _from_tables(tables: dict[str, Any], source: str, written: bool = False) -> Run:
    """The run that TOML tables describe; ``written``: by this program.  Raises ConfigError with ``source`` and the key."""
    problem = tables.get("problem", Run.problem)
    try:
        kind = run_type(problem) if isinstance(problem, str) else Run
    except ConfigError as error:
        raise ConfigError(f"{source}: {error}") from None
    if written and isinstance(problem, str):
        tables = former_names.translated(tables, names_of(kind), plugins.find("problems", problem))
        for section, former in _FORMER.items():
            if isinstance(found := tables.get(section, {}), dict):
                tables = {**tables, section: {**former, **found}}
    else:
        former_names.check(tables, names_of(kind), problem, source)
    run = cast(Run, build(kind, tables, source))
    validate(run, source)
    try:
        owner = plugins.find("problems", run.problem)
        return replace(run, **{owner.section: owner(run.problem, run.section(owner.section)).resolved()})
    except ConfigError as error:
        raise ConfigError(f"{source}: {error}") from None


def names_of(kind: type[Run]) -> set[str]:
    """The names of the sections of a run, and of its keys outside sections."""
    return {item.name for item in dataclasses.fields(kind)}


def with_problem(run: Run, problem: str) -> Run:
    """The run with another problem, without the sections that this problem lacks; the run is not validated.

    Raises ConfigError for a problem that is not installed.
    """
    kind = run_type(problem)
    shared = {name: getattr(run, name) for name in names_of(kind) if hasattr(run, name)}
    return kind(**{**shared, "problem": problem})


def override(run: Run, settings: Sequence[str], source: str) -> Run:
    """The run with ``settings`` such as ``adversary.count=16`` applied; strings need no quotes.

    If the run now has another problem, the sections that this problem lacks are left out, unless a setting names them.
    Raises ConfigError for a malformed setting, an unknown key or an impossible value.
    """
    tables = tomllib.loads(dumps(run))
    for setting in settings:
        name, equals, value = setting.partition("=")
        *path, key = name.strip().split(".")
        if not equals or len(path) > 1:
            raise ConfigError(f"{source} {setting}: write SECTION.NAME=VALUE, as in adversary.count=16")
        table = tables.setdefault(path[0], {}) if path else tables
        try:
            table[key] = tomllib.loads(f"value = {value}")["value"]
        except tomllib.TOMLDecodeError:
            table[key] = value.strip()
        except TypeError:
            raise ConfigError(f"{source} {setting}: {path[0]} is not a section") from None
    if tables["problem"] in plugins.names("problems"):
        named = {setting.partition("=")[0].strip().partition(".")[0] for setting in settings}
        former = set(plugins.sections(None)) - set(plugins.sections(tables["problem"])) - named
        tables = {name: table for name, table in tables.items() if name not in former}
    return _from_tables(tables, source)
