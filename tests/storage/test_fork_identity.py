"""Forks: ``--from`` refuses every change of the problem, its split, the method and the model, and allows other changes."""

from __future__ import annotations

import dataclasses
import typing
from pathlib import Path
from typing import Any

import pytest

from icrl_dist.config import plugins
from icrl_dist.config.run import ConfigError, Run, dumps, make_run, override, validate
from icrl_dist.config.sections import AdversaryConfig, ICAAConfig, ModelConfig, OptimConfig, PretrainConfig
from icrl_dist.launch import train
from icrl_dist.problems.continuous.config import ControlConfig
from icrl_dist.problems.darkroom.config import DarkRoomConfig
from icrl_dist.storage.fork import _check_same

SMALL = ControlConfig(train_tasks=4, test_tasks=3)
RUNS = {
    "darkroom": make_run(method="icaa"),
    "dmc-cartpole-balance": make_run("dmc-cartpole-balance", method="icaa", control=SMALL),
    "metaworld-pick-place": make_run("metaworld-pick-place", method="icaa", control=SMALL),
}
REMEDY = ": a fork has its parent's problem, split, method and model; start a new run instead"

CHOSEN: dict[str, Any] = {
    "control.train_tasks": 16,  # of DeepMind Control's 4, 16 or 36
    "control.horizon": 150,
    "control.strength": 2.0,
    "control.solved": "dmc-cartpole-balance/paper/drop:0.25=3.0",
    "pretrain.behaviors": ("random", "sweep"),
    "model.heads": 2,
}
"""Another valid value of the fields for which the next number is none."""
IMPOSSIBLE = {("dmc-cartpole-balance", "control.histories")}
"""Fields without another valid value in a problem; a fork that has another one is refused anyway."""


def another(section: str, cls: type, field: str, value: Any) -> Any:
    """A value of the field that differs from this one."""
    if f"{section}.{field}" in CHOSEN:
        return CHOSEN[f"{section}.{field}"]
    hint = typing.get_type_hints(cls)[field]
    if typing.get_origin(hint) is typing.Literal:
        return next(choice for choice in typing.get_args(hint) if choice != value)
    if hint is bool:
        return not value
    return value + 1 if hint is int else value / 2 or 0.25


def changed(run: Run, section: str, field: str) -> tuple[Run, Any, Any]:
    """The run with another value of this field; the value before, and after."""
    part = run.section(section)
    before = getattr(part, field)
    after = another(section, type(part), field, before)
    assert after != before
    return dataclasses.replace(run, **{section: dataclasses.replace(part, **{field: after})}), before, after


def cases(problem: str, section: str, cls: Any) -> list[tuple[str, str, str]]:
    return [(problem, section, item.name) for item in dataclasses.fields(cls)]


PROBLEM_FIELDS = [
    *cases("darkroom", "darkroom", DarkRoomConfig),
    *cases("dmc-cartpole-balance", "control", ControlConfig),
    *cases("metaworld-pick-place", "control", ControlConfig),
]


@pytest.mark.parametrize("problem", RUNS)
def test_the_table_has_the_section_of_each_problem(problem: str) -> None:
    owner = plugins.find("problems", problem)
    fields = {item.name for item in dataclasses.fields(owner.Config)}
    assert {field for one, section, field in PROBLEM_FIELDS if (one, section) == (problem, owner.section)} == fields
    assert set(owner.free_in_forks) <= fields
    validate(RUNS[problem], "x")
    _check_same(RUNS[problem], RUNS[problem], "x")


@pytest.mark.parametrize(("problem", "section", "field"), PROBLEM_FIELDS)
def test_a_fork_has_every_field_of_its_parents_problem(problem: str, section: str, field: str) -> None:
    parent = RUNS[problem]
    run, before, after = changed(parent, section, field)
    if (problem, f"{section}.{field}") not in IMPOSSIBLE:
        validate(run, "x")
    if field in plugins.find("problems", problem).free_in_forks:
        _check_same(parent, run, "--from parent@0")
        return
    for one, other, old, new in ((parent, run, before, after), (run, parent, after, before)):
        with pytest.raises(ConfigError) as caught:
            _check_same(one, other, "--from parent@0")
        assert str(caught.value) == f"--from parent@0: {section}.{field} = {new!r} (parent: {old!r}){REMEDY}"


def test_a_fork_may_change_the_strength_of_its_adversaries_and_no_other_field_of_its_problem() -> None:
    free = {name: plugins.find("problems", name).free_in_forks for name in RUNS}
    assert free == {
        "darkroom": (),
        "dmc-cartpole-balance": ("strength", "solved"),
        "metaworld-pick-place": ("strength", "solved"),
    }


@pytest.mark.parametrize("problem", plugins.names("problems"))
@pytest.mark.parametrize("parent", RUNS.values(), ids=RUNS)
def test_a_fork_has_the_problem_of_its_parent(parent: Run, problem: str) -> None:
    if problem == parent.problem:
        return
    run = make_run(problem, method=parent.method)
    if hasattr(run, "control"):
        run = make_run(
            problem, method=parent.method, control=SMALL
        )  # the problem's name is the only difference within DeepMind Control
    with pytest.raises(ConfigError) as caught:
        _check_same(parent, run, "--from parent@0")
    assert str(caught.value) == f"--from parent@0: problem = {problem!r} (parent: {parent.problem!r}){REMEDY}"


@pytest.mark.parametrize("method", plugins.names("methods"))
@pytest.mark.parametrize("parent", RUNS.values(), ids=RUNS)
def test_a_fork_has_the_method_of_its_parent(parent: Run, method: str) -> None:
    if method == parent.method:
        return
    with pytest.raises(ConfigError) as caught:
        _check_same(parent, dataclasses.replace(parent, method=method), "--from parent@0")
    assert str(caught.value) == f"--from parent@0: method = {method!r} (parent: {parent.method!r}){REMEDY}"


@pytest.mark.parametrize(("problem", "section", "field"), [one for name in RUNS for one in cases(name, "model", ModelConfig)])
def test_a_fork_has_every_field_of_its_parents_model(problem: str, section: str, field: str) -> None:
    parent = RUNS[problem]
    run, before, after = changed(parent, section, field)
    with pytest.raises(ConfigError) as caught:
        _check_same(parent, run, "--from parent@0")
    assert str(caught.value) == f"--from parent@0: model.{field} = {after!r} (parent: {before!r}){REMEDY}"


def test_all_differences_are_named() -> None:
    parent = RUNS["darkroom"]
    run = override(parent, ["darkroom.size=9", "darkroom.gamma=0.5", "model.layers=3"], "x")
    with pytest.raises(ConfigError) as caught:
        _check_same(parent, run, "x")
    for one in ("darkroom.size = 9 (parent: 10)", "darkroom.gamma = 0.5 (parent: 0.99)", "model.layers = 3 (parent: 4)"):
        assert one in str(caught.value)
    with pytest.raises(
        ConfigError, match=r"method = 'dpt' \(parent: 'icaa'\), problem = 'dmc-walker-run' \(parent: 'darkroom'\)"
    ):
        _check_same(parent, make_run("dmc-walker-run", method="dpt"), "x")


ALLOWED = {"adversary": AdversaryConfig, "pretrain": PretrainConfig, "icaa": ICAAConfig, "optim": OptimConfig}


@pytest.mark.parametrize(
    ("problem", "section", "field"),
    [one for name in RUNS for section, cls in ALLOWED.items() for one in cases(name, section, cls)],
)
def test_a_fork_may_change_how_it_collects_and_trains(problem: str, section: str, field: str) -> None:
    run, _, _ = changed(RUNS[problem], section, field)
    assert run != RUNS[problem]
    _check_same(RUNS[problem], run, "x")


@pytest.mark.parametrize(
    ("problem", "settings", "difference"),
    [
        ("darkroom", ["darkroom.split_seed=1"], "darkroom.split_seed = 1 (parent: 0)"),
        ("dmc-cartpole-balance", ["control.train_tasks=16"], "control.train_tasks = 16 (parent: 4)"),
        (
            "dmc-cartpole-balance",
            ["problem=dmc-cartpole-swingup"],
            "problem = 'dmc-cartpole-swingup' (parent: 'dmc-cartpole-balance')",
        ),
        ("metaworld-pick-place", ["control.test_tasks=9"], "control.test_tasks = 9 (parent: 3)"),
    ],
)
def test_a_refused_fork_leaves_no_run_folder(problem: str, settings: list[str], difference: str, tmp_path: Path) -> None:
    parent, folder = tmp_path / "parent", tmp_path / "fork"
    parent.mkdir()
    (parent / "run.toml").write_text(dumps(RUNS[problem]))
    with pytest.raises(ConfigError) as caught:
        train.prepare(override(RUNS[problem], settings, "--set"), folder, False, False, (parent, 0))
    assert str(caught.value) == f"--from {parent}@0: {difference}{REMEDY}"
    assert not folder.exists() and [path.name for path in parent.iterdir()] == ["run.toml"]
