"""The list of runs of a sweep, and whether they can be compared.  Nothing is written here."""

from __future__ import annotations

import dataclasses
import hashlib
import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import tomli_w

from icrl_dist.config import plugins
from icrl_dist.config.run import ConfigError, Run, load, override, packaged_runs, validate
from icrl_dist.config.toml import build, nearest
from icrl_dist.methods import budget
from icrl_dist.results.suite_numbers import numbers
from icrl_dist.stream.excerpts import show
from icrl_dist.stream.schema import as_data
from icrl_dist.sweeps.file import EXACT, Evaluation, Only, SweepFile, known

QUANTITIES = ("environment_steps", "labelled_episodes", "optimizer_steps")
"""The budgets that are compared; columns of result rows."""


@dataclass(frozen=True)
class Member:
    """One run of a sweep."""

    setting: str
    variant: str
    """Name of its method in the sweep file."""
    seed: int
    run: Run
    exact: bool
    """Nothing is trained; only reference agents are evaluated."""
    evaluations: Mapping[str, Evaluation]

    @property
    def name(self) -> str:
        return f"{self.setting}/{self.variant}/{self.seed}"

    @property
    def stem(self) -> str:
        """Name of its file of result rows, without the suffix."""
        return self.name.replace("/", "-")

    def place(self, out: Path) -> Path:
        """Its run folder.  Beside it lie ``SEED.json``, its state, and ``SEED.log``."""
        return out / self.setting / self.variant / str(self.seed)


def digest(member: Member, evaluation: Evaluation) -> str:
    """SHA-256 of everything that an evaluation of a run depends on, beside the weights."""
    settings = as_data(evaluated(member.run, evaluation).evaluate)
    key: dict[str, Any] = {"suite": evaluation.suite, "deploy": evaluation.deploy, "exact": member.exact, "evaluate": settings}
    key |= {"draws": evaluation.draws} if evaluation.suite == "attack" else {}
    key |= {"rounds": True} if evaluation.rounds else {}
    return hashlib.sha256(json.dumps(key, sort_keys=True).encode()).hexdigest()


def evaluated(run: Run, evaluation: Evaluation) -> Run:
    """The run with the numbers of an evaluation in ``[evaluate]``."""
    chosen = numbers(run, evaluation.suite, evaluation.overrides())
    return dataclasses.replace(run, evaluate=dataclasses.replace(run.evaluate, **chosen))


def members(sweep: SweepFile, source: Path) -> tuple[Member, ...]:
    """All runs of a sweep file, seed by seed, so that comparisons are possible early.

    ``source``: the file, for messages and for the path of the base run.  Raises ConfigError for an unknown method or
    setting, a value that the run file refuses (with setting, method and key), and two runs of one name.
    """
    base = override(_base(sweep, source), ["learner.threads=1"], str(source))
    found = []
    for variant, table in sweep.methods.items():
        where = f"{source}: [methods.{variant}]"
        only = build(Only, table["only"], f"{where} only") if "only" in table else Only()
        assert isinstance(only, Only)
        known(only.settings, sweep.settings, f"{where} only.settings")
        if only.methods:
            raise ConfigError(f"{where} only.methods: a method is limited to settings and seeds; leave it out")
        keys = {name: value for name, value in table.items() if name != "only"}
        exact = _method(keys, where) == EXACT
        if exact:
            del keys["method"]
        for setting in only.settings or sweep.settings:
            changed = _changed(base, sweep.settings[setting], f"{source}: [settings.{setting}]")
            _check_seeds(sweep, changed, sweep.settings[setting], f"{source}: [settings.{setting}]")
            place = f"{where} in setting {setting}"
            run = _changed(changed, keys, place)
            _check_seeds(sweep, run, keys, where)
            wanted = {
                name: one
                for name, one in sweep.evaluations.items()
                if setting in (one.only.settings or (setting,)) and variant in (one.only.methods or (variant,))
            }
            evaluations = _possible(run, wanted, exact, source, place)
            for number in only.seeds or sweep.seeds:
                seeded = _changed(run, _seeds(run, number, sweep.split_seed, str(source)), place)
                found.append(Member(setting, variant, number, seeded, exact, evaluations))
    found = [one for one in found if one.evaluations or not one.exact]
    names: dict[str, str] = {}
    for one in found:
        if other := names.get(one.stem.lower()):
            raise ConfigError(f"{source}: two runs of one name: {other} and {one.name}; rename one, and name each seed once")
        names[one.stem.lower()] = one.name
    order = {seed: None for one in found for seed in (one.seed,)}
    return tuple(one for seed in order for one in found if one.seed == seed)


def _base(sweep: SweepFile, source: Path) -> Run:
    beside = source.parent / sweep.run
    path = sweep.run not in packaged_runs() and (sweep.run.endswith(".toml") or beside.is_dir())
    try:
        return load(str(beside) if path else sweep.run)
    except ConfigError as error:
        raise ConfigError(f"{source}: {error}") from None


def _method(keys: Mapping[str, Any], where: str) -> str:
    """The method of a variant.  Raises ConfigError, with the nearest name, for one that is not installed or trains nothing."""
    there = [*plugins.names("methods"), EXACT]
    if "method" not in keys:
        raise ConfigError(f"{where}: has no key method; choose one of {', '.join(there)}")
    name = keys["method"]
    if not isinstance(name, str) or name not in there:
        raise ConfigError(f"{where}: method = {show(name)}{nearest(str(name), there)}; choose one of {', '.join(there)}")
    if name != EXACT and not plugins.find("methods", name).trains:
        raise ConfigError(f"{where}: method = {name!r}: it trains no model; train it with `icrl-dist train`")
    return name


def _changed(run: Run, table: Mapping[str, Any], where: str) -> Run:
    """The run with the keys of a table of the sweep file, checked as those of a run file."""
    settings = []
    for name, value in table.items():
        if not isinstance(value, dict):
            settings.append(_setting(name, value))
        else:
            settings += [_setting(f"{name}.{key}", one) for key, one in value.items()]
    return override(run, settings, where) if settings else run


def _setting(key: str, value: object) -> str:
    return (
        f"{key}={tomli_w.dumps({'value': value}).partition('=')[2].strip()}" if not isinstance(value, dict) else f"{key}={{}}"
    )


def _check_seeds(sweep: SweepFile, run: Run, table: Mapping[str, Any], where: str) -> None:
    """Raises ConfigError for a key that ``seeds`` or ``split_seed`` of the file would replace in silence."""
    if "seed" in table:
        raise ConfigError(
            f"{where}: seed = {show(table['seed'])}: training seeds are those of seeds; use only = {{seeds = ...}}"
        )
    section = plugins.find("problems", run.problem).section
    if sweep.split_seed is not None and isinstance(table.get(section), dict) and "split_seed" in table[section]:
        raise ConfigError(f"{where}: {section}.split_seed: split_seed of the file sets it; leave one of the two out")


def _seeds(run: Run, seed: int, split_seed: str | int | None, source: str) -> dict[str, Any]:
    """The keys that a training seed sets."""
    if split_seed is None:
        return {"seed": seed}
    section = plugins.find("problems", run.problem).section
    if not hasattr(run.section(section), "split_seed"):
        raise ConfigError(f"{source}: split_seed: problem {run.problem!r} has no split seed; leave it out")
    return {"seed": seed, section: {"split_seed": seed if split_seed == "seed" else split_seed}}


def _possible(
    run: Run, evaluations: Mapping[str, Evaluation], exact: bool, source: Path, place: str
) -> Mapping[str, Evaluation]:
    """The evaluations that the run can have.  Raises ConfigError for one that it should have and cannot."""
    found = {}
    for name, one in evaluations.items():
        where = f"{source}: [evaluations.{name}] for {place.rpartition(': ')[2]}"
        validate(evaluated(run, one), where)
        try:
            if not (exact and one.suite == "posterior"):  # it compares a model with the exact posterior
                _require_suite(run, one)
                found[name] = one
        except ConfigError as error:
            raise ConfigError(f"{where}: {error}") from None
    return found


def _require_suite(run: Run, evaluation: Evaluation) -> None:
    if evaluation.deploy == "committed" and run.model.window == 1:
        raise ConfigError("deploy = 'committed': the model has no action windows; set model.window, or leave deploy out")
    if evaluation.suite != "online":
        from icrl_dist.telemetry.processes import import_torch

        import_torch()
        from icrl_dist.results import heldout

        heldout.check_suite(evaluated(run, evaluation), evaluation.suite)


def chosen(
    every: Sequence[Member], only: Sequence[str] = (), settings: Sequence[str] = (), seeds: Sequence[int] = ()
) -> tuple[Member, ...]:
    """The runs with these methods, settings and seeds; empty: all.  Raises ConfigError for a name that no run has."""
    for option, names, there in (
        ("--only", tuple(only), {one.variant: None for one in every}),
        ("--settings", tuple(settings), {one.setting: None for one in every}),
        ("--seeds", tuple(map(str, seeds)), {str(one.seed): None for one in every}),
    ):
        known(names, there, option)
    found = tuple(
        one
        for one in every
        if one.variant in (only or (one.variant,))
        and one.setting in (settings or (one.setting,))
        and one.seed in (seeds or (one.seed,))
    )
    if not found:
        raise ConfigError("--only, --settings and --seeds select no run; leave one of them out")
    return found


def check_equal(every: Sequence[Member], sweep: SweepFile, source: str) -> None:
    """Raises ConfigError if the methods of one setting differ in seeds, splits or budgets beyond what ``[equal]`` allows."""
    for line in differences(every, sweep):
        raise ConfigError(f"{source}: {line}; make them equal, or say in [equal] that they may differ")


def differences(every: Sequence[Member], sweep: SweepFile) -> Iterator[str]:
    """What makes the methods of one setting no fair comparison, a line each."""
    equal = sweep.equal
    for setting in {one.setting: None for one in every}:
        ones = [one for one in every if one.setting == setting and one.variant not in equal.methods]
        of = {variant: [one for one in ones if one.variant == variant] for variant in {one.variant: None for one in ones}}
        if not of:
            continue
        first, *others = of
        for other in others:
            here, there = ({one.seed for one in of[variant]} for variant in (first, other))
            if equal.seeds and here != there:
                yield f"setting {setting}: training seeds {sorted(here)} of {first} and {sorted(there)} of {other} differ"
        splits: dict[int, tuple[Member, int | None]] = {}
        for one in ones:
            split = budget.split_seed(one.run)
            before, known_split = splits.setdefault(one.seed, (one, split))
            if split != known_split:
                pair = f"{before.name} ({known_split}) and {one.name} ({split})"
                yield f"setting {setting}: split seeds of {pair} differ"
        trained = {variant: budget.of(found[0].run) for variant, found in of.items() if not found[0].exact}
        for column in QUANTITIES:
            values = {variant: getattr(one, column) for variant, one in trained.items()}
            if line := _apart(column, values, getattr(equal, column)):
                yield f"setting {setting}: {line}"


def _apart(column: str, values: Mapping[str, int | None], allowed: float) -> str:
    """By how much a budget differs between methods, if that is more than allowed; else an empty text."""
    name, known_ones = budget.COMPARED[column], {variant: value for variant, value in values.items() if value is not None}
    unknown = [variant for variant in values if variant not in known_ones]
    if known_ones and unknown and allowed < 1:
        return f"{name} of {', '.join(unknown)} are not known"
    if not known_ones:
        return ""
    low, high = min(known_ones, key=known_ones.__getitem__), max(known_ones, key=known_ones.__getitem__)
    least, most = known_ones[low], known_ones[high]
    if most - least <= allowed * most:
        return ""
    share = f"a difference of {(most - least) / most:.3g}, and {column} = {allowed:g} is allowed"
    return f"{name} differ: {least:,} of {low} and {most:,} of {high}, {share}"
