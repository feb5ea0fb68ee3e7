"""Validation of runs of problems and methods of another package."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, ClassVar

import pytest

from icrl_dist.config.run import ConfigError, Run, load, override
from icrl_dist.problems import registry
from icrl_dist.types import Split
from tests.toys.corridor import CorridorConfig, CorridorProblem
from tests.toys.return_to_go import ReturnToGo

Make = Callable[..., Run]


def test_an_unknown_behavior_policy_is_refused_with_the_names_that_the_problem_has(toy_run: Make) -> None:
    assert toy_run("pretrain.behaviors=['random', 'leftward']").pretrain.behaviors == ("random", "leftward")
    with pytest.raises(ConfigError, match=r"pretrain.behaviors = .*'sweep'.*: choose from random, leftward$"):
        toy_run("pretrain.behaviors=['random', 'sweep']")


def test_behavior_policies_are_refused_for_a_problem_without_any() -> None:
    message = "pretrain.behaviors = .*: dmc-cartpole-balance has no behavior policies; leave it out$"
    with pytest.raises(ConfigError, match=message):
        override(load("dmc-cartpole-balance-laptop"), ["pretrain.behaviors=['sweep']"], "--set")


@pytest.mark.parametrize("part", ["labeller", "behaviors"])
def test_contexts_that_need_a_part_which_the_problem_lacks_are_refused(toy_run: Make, part: str) -> None:
    lacking = type("Lacking", (CorridorProblem,), {part: None})
    message = rf"problem = 'toy-corridor': its contexts \(jobs behavior_context\) need Problem.{part}, which is None; define it"
    with pytest.raises(ConfigError, match=message):
        toy_run(problem=lacking)


def test_a_problem_without_training_tasks_is_refused(toy_run: Make) -> None:
    class Empty(CorridorProblem):
        def make_split(self) -> Split:
            return Split((), super().make_split().test)

    with pytest.raises(ConfigError, match="problem = 'toy-corridor': its split has no training tasks"):
        toy_run(problem=Empty)


def test_a_problem_without_tasks_to_evaluate_on_is_refused_before_a_training(toy_run: Make) -> None:
    class Untested(CorridorProblem):
        def make_split(self) -> Split:
            return Split(super().make_split().train, ())

    with pytest.raises(ConfigError, match="problem = 'toy-corridor': it has no tasks to evaluate on"):
        toy_run(problem=Untested)


def test_a_section_may_have_class_variables_of_any_type(toy_run: Make) -> None:
    @dataclass(frozen=True)
    class WithTable(CorridorConfig):
        """A section with a table that all of its instances share."""

        TABLE: ClassVar[dict[str, int]] = {"one": 1}

    assert toy_run(problem=type("Tabled", (CorridorProblem,), {"Config": WithTable})).problem == "toy-corridor"


@dataclass(frozen=True)
class Inner:
    weights: dict[str, float] = field(default_factory=dict)


@dataclass
class Thawed:
    goal: int = 1


def config_with(hint: Any, default: Any) -> type:
    fields = [("cells", int, 6), ("horizon", int, 8), ("odd", hint, field(default_factory=lambda: default))]
    return dataclasses.make_dataclass("Section", fields, frozen=True)


@pytest.mark.parametrize(
    ("hint", "default"),
    [
        (dict[str, float], {}),
        (list[int], []),
        (dict[str, float] | None, None),
        (tuple[dict[str, int], ...], ()),
        (Inner, Inner()),
        (Thawed, Thawed()),
    ],
)
@pytest.mark.parametrize("group", ["problems", "methods"])
def test_a_section_with_a_field_that_cannot_be_hashed_is_refused(
    install: Callable[..., None], group: str, hint: Any, default: Any
) -> None:
    base: Any = CorridorProblem if group == "problems" else ReturnToGo

    class Odd(base):  # type: ignore[misc]
        section: ClassVar[str] = "odd_section"
        Config: ClassVar[type] = config_with(hint, default)

    install(**{group: {"odd": Odd}})
    message = r"= 'odd': section \[odd_section\], field odd: .* can change, so .*; use a tuple or a frozen dataclass"
    with pytest.raises(ConfigError, match=message):
        override(load("smoke"), [f"{group.removesuffix('s')}=odd"], "--set")
    assert load("smoke").problem == "darkroom", "it is an error only for its own runs"


@pytest.mark.parametrize(
    ("made", "message"),
    [
        (dataclasses.make_dataclass("NoDefault", [("odd", int)], frozen=True), "missing .* 'odd'"),
        (dataclasses.make_dataclass("Complex", [("odd", complex, 1j)], frozen=True), "complex.*cannot be decoded"),
        (dataclasses.make_dataclass("Open", [("odd", int, 1)]), r"use @dataclass\(frozen=True\)"),
        (int, r"use @dataclass\(frozen=True\)"),
    ],
)
def test_a_section_that_a_run_file_cannot_hold_is_refused(install: Callable[..., None], made: type, message: str) -> None:
    install(problems={"odd": type("Odd", (CorridorProblem,), {"section": "odd_section", "Config": made})})
    with pytest.raises(ConfigError, match=rf"= 'odd': section \[odd_section\].*{message}"):
        override(load("smoke"), ["problem=odd"], "--set")


@pytest.mark.parametrize("group", ["problems", "methods"])
def test_a_class_that_is_no_problem_or_method_is_an_error_only_for_its_own_runs(
    install: Callable[..., None], group: str
) -> None:
    install(**{group: {"odd": type("Odd", (), {})}})
    with pytest.raises(ConfigError, match=r"= 'odd': .*'Odd' has no attribute 'section'"):
        override(load("smoke"), [f"{group.removesuffix('s')}=odd"], "--set")
    assert load("smoke").problem == "darkroom"


def test_a_section_may_have_tuples_and_frozen_dataclasses(toy_run: Make) -> None:
    inner = dataclasses.make_dataclass("Pair", [("left", float, 0.5)], frozen=True)
    made = dataclasses.make_dataclass(
        "Section",
        [("cells", int, 6), ("horizon", int, 8), ("pair", inner, inner()), ("steps", tuple[int, ...], ())],
        frozen=True,
    )
    run = toy_run("corridor.steps=[1, 2]", problem=type("Paired", (CorridorProblem,), {"Config": made}))
    assert registry.of(run) is registry.of(run) and registry.of(run).config.steps == (1, 2)
