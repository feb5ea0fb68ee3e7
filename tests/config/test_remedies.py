"""Ranges that depend on other settings: the remedy that a message states is itself accepted."""

from __future__ import annotations

import re
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from icrl_dist.config.ranges import remedy
from icrl_dist.config.run import ConfigError, Run, make_run, override, validate
from icrl_dist.problems.metaworld import pick_place

MESSAGE = re.compile(r"x: ([\w.]+) = (\S+): use (?:(at least) )?(\d+)(?: to (\d+)|, (\d+) or (\d+))?(?:, or \S+ = \d+)?: .+")
"""A message about a computed range, as ``ranges.remedy`` words it; ``use 4, 16 or 36`` for a choice of three."""


def refusal(run: Run) -> str:
    """The message that the run is refused with; empty for a possible run."""
    try:
        validate(run, "x")
    except ConfigError as error:
        return str(error)
    return ""


def changed(run: Run, where: str, value: int) -> Run:
    """The run with another number, which is not checked."""
    section, _, name = where.partition(".")
    part = run.section(section)
    return type(run)(
        **{
            **{item: getattr(run, item) for item in run.__dataclass_fields__},
            section: type(part)(**{**vars(part), name: value}),
        }
    )


def stated(message: str) -> tuple[str, list[int]]:
    """The field that a message names, and the outermost numbers that it allows."""
    found = MESSAGE.fullmatch(message)
    assert found, message
    where, _, least, *numbers = found.groups()
    allowed = [int(number) for number in numbers if number is not None]
    assert allowed == sorted(allowed) and (not least or int(allowed[0]) >= 0), message
    return where, [allowed[0], allowed[-1]]


NUMBERS = {
    "darkroom": {
        "darkroom.size": st.integers(2, 4),
        "darkroom.horizon": st.integers(1, 20),
        "pretrain.contexts": st.integers(1, 20),
    },
    pick_place.KIND: {
        "control.train_tasks": st.integers(1, 120),
        "control.test_tasks": st.integers(1, 120),
        "control.horizon": st.integers(0, 700),
        "pretrain.contexts": st.integers(1, 130),
        "stream.job_tasks": st.integers(1, 6),
    },
    "dmc-hopper-hop": {
        "control.train_tasks": st.sampled_from([1, 4, 9, 16, 36, 64]),
        "control.test_tasks": st.integers(1, 100),
        "control.horizon": st.integers(0, 300),
        "stream.job_tasks": st.integers(1, 6),
    },
}
SHARED = {
    "icaa.trials": st.integers(1, 5),
    "icaa.context_trials": st.integers(0, 8),
    "model.window": st.integers(1, 30),
    "pretrain.windows": st.integers(0, 2),
    "optim.windows": st.integers(0, 2),
    "context.max": st.integers(1, 40),
}


@pytest.mark.parametrize("problem", NUMBERS)
@settings(max_examples=150, deadline=None)
@given(data=st.data())
def test_each_stated_remedy_is_accepted(problem: str, data: Any) -> None:
    """The lowest and the highest stated number end the objection to the field; after a few changes the run is possible."""
    run = make_run(problem)
    for where, numbers in {**SHARED, **NUMBERS[problem]}.items():
        run = changed(run, where, data.draw(numbers, where))
    for _ in range(12):
        message = refusal(run)
        if not message:
            return
        where, ends = stated(message)
        for end in ends:
            mended = changed(run, where, end) if where != "pretrain.decoy_fraction" else changed(run, where, 0)
            after = refusal(mended)
            assert not after.startswith(f"x: {where} = "), f"{message} -> {after}"
        run = mended
    raise AssertionError(f"still refused: {message}")


@pytest.mark.parametrize(
    ("train", "test", "message"),
    [
        (16, 60, "control.test_tasks = 60: use 1 to 34: ML1 has 50 tasks, for training and test together"),
        (60, 5, "control.train_tasks = 60: use 1 to 45: ML1 has 50 tasks, for training and test together"),
        (1, 50, "control.test_tasks = 50: use 1 to 49: "),
        (49, 60, "control.test_tasks = 60: use 1: "),
        (60, 50, "control.train_tasks = 60: use 1: "),
    ],
)
def test_too_many_tasks_of_ml1(train: int, test: int, message: str) -> None:
    with pytest.raises(ConfigError) as caught:
        override(make_run(pick_place.KIND), [f"control.train_tasks={train}", f"control.test_tasks={test}"], "x")
    assert str(caught.value).startswith(f"x: {message}")
    assert ("must also be at most 49" in str(caught.value)) == (min(train, test) >= 50)


@pytest.mark.parametrize(("tasks", "together", "remedy"), [(5, 4, "stream.job_tasks = 3"), (1, 4, "control.train_tasks = 2")])
def test_decoys_need_a_second_expert(tasks: int, together: int, remedy: str) -> None:
    words = [f"control.train_tasks={tasks}", f"stream.job_tasks={together}", "model.window=2", "optim.windows=1"]
    words += ["pretrain.windows=1", "pretrain.contexts=100"]
    with pytest.raises(ConfigError, match=f"pretrain.decoy_fraction = 0.3: use 0, or {remedy}: decoys need"):
        override(make_run(pick_place.KIND), words, "x")
    override(make_run(pick_place.KIND), [*words, remedy.replace(" ", "")], "x")
    override(make_run(pick_place.KIND), [*words, "pretrain.decoy_fraction=0"], "x")


def test_an_empty_range_is_no_remedy() -> None:
    assert (remedy(1, 4, "r"), remedy(2, 2, "r"), remedy(3, None, "r")) == ("use 1 to 4: r", "use 2: r", "use at least 3: r")
    with pytest.raises(ValueError, match="3 to 2 is empty"):
        remedy(3, 2, "r")
