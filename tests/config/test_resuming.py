"""Which numbers a resumed run may change: those in one list, and no other."""

import dataclasses
from typing import Any

import pytest

from icrl_dist.config.resuming import FREE, differences
from icrl_dist.config.run import Run, load


def numbers(run: Run) -> list[tuple[str, str]]:
    """Section and name of every number of a run; the section of one outside of sections is empty."""
    found = []
    for item in dataclasses.fields(run):
        value = getattr(run, item.name)
        inner = dataclasses.fields(value) if dataclasses.is_dataclass(value) else ()
        found += [(item.name, field.name) for field in inner] or [("", item.name)]
    return found


def changed(run: Run, section: str, name: str) -> Run:
    """The run with another value, of any type, for one number."""
    return _with(run, name, "another") if not section else _with(run, section, _with(run.section(section), name, "another"))


def _with(of: Any, name: str, value: Any) -> Any:
    """A copy with one other attribute, whose type is not checked."""
    other = object.__new__(type(of))
    other.__dict__.update(vars(of) | {name: value})
    return other


@pytest.mark.parametrize("name", ["smoke", "dmc-cartpole-balance-laptop", "metaworld-laptop"])
def test_a_number_differs_if_and_only_if_it_is_not_in_the_list(name):
    run = load(name)
    assert len(numbers(run)) > 60
    for section, key in numbers(run):
        found = differences(run, changed(run, section, key))
        if key in FREE.get(section, ()):
            assert found == [], (section, key)
        else:
            (one,) = found
            before = getattr(run.section(section) if section else run, key)
            assert one == (f"{section}.{key}".lstrip("."), before, "another")


def test_every_free_number_exists():
    assert {(section, key) for section, keys in FREE.items() for key in keys} <= set(numbers(load("smoke")))


def test_runs_of_two_problems_differ_in_the_problem():
    found = {one.name for one in differences(load("smoke"), load("dmc-cartpole-balance-laptop"))}
    assert "problem" in found and not [name for name in found if name.startswith(("darkroom", "control"))]
