"""Shared by all tests: shape checks at every call, one torch thread, small runs."""

from __future__ import annotations

import contextlib
import gc
import os
import signal
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

os.environ.setdefault("OMP_NUM_THREADS", "1")  # for programs that tests start: several programs share the cores

import pytest
import torch

import tests.typecheck

if signal.getsignal(signal.SIGINT) == signal.SIG_IGN:  # started by a shell's "&": child processes would ignore Ctrl-C too
    signal.signal(signal.SIGINT, signal.default_int_handler)
gc.disable()  # until everything is imported
pytest.register_assert_rewrite("tests.contracts")

imported = [name for name in sys.modules if name.split(".")[0] == "icrl_dist"]
assert not imported, f"{imported} were imported before the import hook, so their shapes would not be checked"
tests.typecheck.install("icrl_dist")
torch.set_num_threads(1)

from icrl_dist.config.run import Run, make_run
from icrl_dist.config.sections import (
    AdversaryConfig,
    ContextConfig,
    EvaluateConfig,
    ICAAConfig,
    LearnerConfig,
    ModelConfig,
    OptimConfig,
    PretrainConfig,
    StreamConfig,
)
from icrl_dist.problems.darkroom import room as darkroom
from icrl_dist.problems.darkroom.config import DarkRoomConfig
from icrl_dist.stream.memory_link import MemoryHub, MemoryLink
from icrl_dist.types import Task

HERE = Path(__file__).parent
FIRST = ("e2e", "learner", "actors")
"""Folders with slow tests, which run first so that no core is idle at the end."""
TIERS = ("unit", "integration", "e2e")
"""The markers of which each test has one, see CONTRIBUTING.md."""


def tier(item: pytest.Item) -> str:
    """The tier of a test without a marker of its own.

    A fixture that is made once for a module (or for all) exists because it trains, or starts a process or a session.
    """
    if "e2e" in item.path.relative_to(HERE).parts:
        return "e2e"
    made = [one for found in item._fixtureinfo.name2fixturedefs.values() for one in found]  # type: ignore[attr-defined]
    shared = {one.argname for one in made if one.scope != "function" and one.baseid.startswith("tests")}
    return "integration" if shared - {"module_run"} else "unit"


def pytest_ignore_collect(collection_path: Path, config: pytest.Config) -> bool | None:
    """With ``-m unit``, do not import modules without unit tests: their imports cost more than many tests."""
    if config.option.markexpr != "unit" or HERE not in collection_path.parents:
        return None
    if collection_path.is_dir():
        return True if collection_path.name == "e2e" else None
    return True if collection_path.suffix == ".py" and NO_UNIT_TEST in collection_path.read_text() else None


NO_UNIT_TEST = "\npytestmark = pytest.mark.integration\n"


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    def position(item: pytest.Item) -> int:
        folder = item.path.relative_to(HERE).parts[0]
        return FIRST.index(folder) if folder in FIRST else len(FIRST)

    items.sort(key=position)
    for item in items:
        if not any(map(item.get_closest_marker, TIERS)):
            item.add_marker(tier(item))


running_unit_test = False


@pytest.hookimpl(wrapper=True)
def pytest_runtest_protocol(item: pytest.Item) -> Iterator[None]:
    global running_unit_test
    running_unit_test = item.get_closest_marker("unit") is not None
    try:
        return (yield)
    finally:
        running_unit_test = False


def refuse_in_unit_tests(what: str) -> None:
    if running_unit_test:
        raise AssertionError(f"a unit test {what}: mark it with @pytest.mark.integration")


def refuse_processes(event: str, arguments: tuple[Any, ...]) -> None:
    """An audit hook.  Programs outside this environment pass: libraries run some (fc-list) when they are first used."""
    if event == "subprocess.Popen" and str(arguments[0]).startswith(sys.prefix):
        refuse_in_unit_tests("starts a Python process")


sys.addaudithook(refuse_processes)


def pytest_collection_finish() -> None:
    """Exclude imported objects from garbage collection, because they stay until the end; guard Zenoh."""
    gc.collect()
    gc.freeze()
    gc.enable()
    if zenoh := sys.modules.get("zenoh"):
        opened = zenoh.open

        def open_session(*arguments: Any) -> Any:
            refuse_in_unit_tests("opens a Zenoh session")
            return opened(*arguments)

        zenoh.open = open_session  # type: ignore[attr-defined]


@pytest.fixture
def no_ray_token(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """A home folder and an environment without a Ray token; Ray leaves one after it has started a cluster."""
    monkeypatch.setenv("HOME", str(tmp_path))
    for name in ("RAY_AUTH_MODE", "RAY_AUTH_TOKEN", "RAY_AUTH_TOKEN_PATH"):
        monkeypatch.delenv(name, raising=False)


@pytest.fixture
def room() -> Callable[[int, int], tuple[Task, ...]]:
    """``room(size, horizon)``: the tasks of one room, a goal in every cell, in cell order."""

    def tasks(size: int, horizon: int) -> tuple[Task, ...]:
        return tuple(darkroom.task(divmod(cell, size), size, horizon) for cell in range(size * size))

    return tasks


@pytest.fixture
def small_run(module_run: Run) -> Run:
    """A complete run in a 3x3 room, small enough for a test."""
    return module_run


@pytest.fixture(scope="session")
def module_run() -> Run:
    """``small_run`` for fixtures of a wider scope than one test."""
    return make_run(
        method="icaa",
        darkroom=DarkRoomConfig(size=3, horizon=8),
        adversary=AdversaryConfig(count=2),
        pretrain=PretrainConfig(contexts=42, queries=4, steps=10),
        icaa=ICAAConfig(rounds=1, trials=4, context_trials=1, steps=5),
        model=ModelConfig(layers=2, width=16),
        optim=OptimConfig(batch=8, queries=4, episodes=2, warmup=2),
        context=ContextConfig(max=40),
        evaluate=EvaluateConfig(episodes=3, seeds=2),
        stream=StreamConfig(job_tasks=2),
        learner=LearnerConfig(threads=1),
    )


@pytest.fixture
def install(monkeypatch: pytest.MonkeyPatch) -> Iterator[Callable[..., None]]:
    """``install(problems={name: class}, methods={name: class})``: these are found until the test ends."""
    from tests.toys import installed

    with contextlib.ExitStack() as stack:
        yield lambda **groups: stack.enter_context(installed(monkeypatch, **groups))


@pytest.fixture
def toy_run(install: Callable[..., None]) -> Callable[..., Run]:
    """``toy_run(method="icag", problem=CLASS, *settings)``: a run in the corridor of ``tests/toys``, or in ``problem``."""
    from icrl_dist.config.run import override, parse
    from tests.toys.corridor import CorridorProblem
    from tests.toys.return_to_go import ReturnToGo

    def make(*settings: str, method: str = "icag", problem: type = CorridorProblem) -> Run:
        install(problems={"toy-corridor": problem}, methods={"return-to-go": ReturnToGo})
        return override(parse(f'problem = "toy-corridor"\nmethod = "{method}"\n{_TOY_RUN}', "toy.toml"), settings, "--set")

    return make


_TOY_RUN = """
[corridor]
cells = 5
[adversary]
count = 1
[pretrain]
contexts = 32
steps = 5
[icaa]
rounds = 0
trials = 3
context_trials = 1
steps = 5
[model]
width = 8
layers = 1
[optim]
batch = 8
episodes = 2
[evaluate]
episodes = 3
seeds = 2
[learner]
threads = 1
[stream]
job_tasks = 2
"""


@pytest.fixture
def hub() -> Iterator[Callable[[], MemoryLink]]:
    """``hub()`` returns a new link to one network within this process."""
    network, links = MemoryHub(), []

    def link() -> MemoryLink:
        links.append(network.link())
        return links[-1]

    yield link
    for one in links:
        one.close()
