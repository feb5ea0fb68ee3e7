"""No general module depends on one problem: it neither compares a problem's name nor imports a problem's folder.

Modules ask the ``Problem`` object for the part that they need; the registry finds the object.
"""

from __future__ import annotations

import ast
from collections.abc import Iterator
from pathlib import Path

import pytest

from icrl_dist.problems import registry

ROOT = Path(__file__).parents[2]
PROBLEMS = ROOT / "icrl_dist" / "problems"
FOLDERS = sorted({type(registry.problem(name)).__module__.split(".")[2] for name in registry.names()})
"""The folders that hold the class of an installed problem; ``continuous`` holds what several problems share."""
NAMES = {*registry.names(), *(name.partition("-")[0] for name in registry.names())}
"""Names of problems, and of families of problems such as ``dmc``."""
EXCEPTIONS = {
    "icrl_dist/__init__.py": "the public name ``icrl_dist.oracle`` is the solver of Dark Room, imported when it is first used",
}


def general_modules() -> list[Path]:
    """Every module outside the folder of problems; packaged run files (``config/runs``) name their problem."""
    files = [path for package in ("icrl_dist", "actors", "learner") for path in (ROOT / package).rglob("*.py")]
    return [path for path in files if PROBLEMS not in path.parents and ROOT / "icrl_dist/config/runs" not in path.parents]


def texts(node: ast.AST | None) -> Iterator[str]:
    """The string literals of an expression, those in its tuples, lists, sets and dicts included."""
    if isinstance(node, ast.Constant) and isinstance(node.value, str):
        yield node.value
    elif isinstance(node, ast.Tuple | ast.List | ast.Set):
        for one in node.elts:
            yield from texts(one)
    elif isinstance(node, ast.Dict):
        for key in node.keys:
            yield from texts(key)


def is_prefix(text: str) -> bool:
    """Whether a text separates some problems from others by the beginning of their names."""
    return len(text) > 2 and any(name.startswith(text) for name in registry.names())


def compared(node: ast.AST) -> Iterator[str]:
    """The literals by which a node distinguishes values."""
    if isinstance(node, ast.Compare):
        for operand in (node.left, *node.comparators):
            yield from (text for text in texts(operand) if text in NAMES)
            yield from (text for text in texts(operand) if text.rstrip("-") in NAMES and text.endswith("-"))
    elif isinstance(node, ast.MatchValue):
        yield from (text for text in texts(node.value) if text in NAMES)
    elif isinstance(node, ast.MatchMapping):
        yield from (text for key in node.keys for text in texts(key) if text in NAMES)
    elif isinstance(node, ast.Dict):
        yield from (text for text in texts(node) if text in NAMES)
    elif isinstance(node, ast.Call) and isinstance(node.func, ast.Attribute):
        arguments = [text for argument in node.args for text in texts(argument)]
        if node.func.attr in ("startswith", "removeprefix", "partition"):
            yield from filter(is_prefix, arguments)
        elif node.func.attr in ("get", "pop", "setdefault", "index", "count", "endswith", "find"):
            yield from (text for text in arguments[:1] if text in NAMES)


def imported(node: ast.AST) -> Iterator[str]:
    """The modules that a node imports, ``importlib.import_module("...")`` included."""
    if isinstance(node, ast.Import):
        yield from (alias.name for alias in node.names)
    elif isinstance(node, ast.ImportFrom):
        assert node.level == 0, "relative imports are not searched"
        yield from (f"{node.module}.{alias.name}" for alias in node.names)
    elif isinstance(node, ast.Constant) and isinstance(node.value, str) and " " not in node.value:
        yield node.value


def violations(source: str) -> list[str]:
    """What binds a module to one problem, with line numbers."""
    found = []
    for node in ast.walk(ast.parse(source)):
        line = getattr(node, "lineno", 0)
        found += [f"line {line}: distinguishes {text!r}" for text in compared(node)]
        for module in imported(node):
            if any(f"{module}.".startswith(f"icrl_dist.problems.{folder}.") for folder in FOLDERS):
                found.append(f"line {line}: imports {module}")
    return found


@pytest.mark.parametrize("path", general_modules(), ids=lambda path: path.relative_to(ROOT).as_posix())
def test_a_general_module_names_no_problem(path: Path) -> None:
    found = violations(path.read_text(encoding="utf-8"))
    if path.relative_to(ROOT).as_posix() in EXCEPTIONS:
        assert found, "this exception is no longer needed: remove it"
    else:
        assert not found, "ask the Problem object (icrl_dist.interfaces) for the part that is needed"


def test_folders_and_names_are_found() -> None:
    assert {"darkroom", "dmc", "metaworld"} == set(FOLDERS)
    assert {"darkroom", "dmc", "dmc-cheetah-run", "metaworld", "metaworld-pick-place"} <= NAMES
    assert len(general_modules()) > 100 and set(EXCEPTIONS) <= {p.relative_to(ROOT).as_posix() for p in general_modules()}


@pytest.mark.parametrize(
    "source",
    [
        'if run.problem == "darkroom": pass',
        'if "darkroom" != kind: pass',
        'x = task.kind in ("darkroom", "other")',
        'x = name.startswith("dmc-")',
        'x = name.startswith(("other", "metaworld"))',
        'x = name.removeprefix("dmc-")',
        'x = "dmc-" in name',
        'match kind:\n    case "dmc-cheetah-run": pass',
        'match kind:\n    case "other" | "darkroom": pass',
        'TABLE = {"darkroom": 1}',
        'x = table.get("darkroom")',
        "import icrl_dist.problems.dmc.suite",
        "from icrl_dist.problems import darkroom",
        "from icrl_dist.problems.metaworld.pick_place import KIND",
        "def f():\n    from icrl_dist.problems.metaworld import environment",
        'importlib.import_module("icrl_dist.problems.darkroom.solver")',
    ],
)
def test_every_way_to_name_a_problem_is_found(source: str) -> None:
    assert violations(source)


@pytest.mark.parametrize(
    "source",
    [
        'problem: str = "darkroom"',
        '"""Trains ``darkroom``."""',
        "if run.problem == other: pass",
        'x = registry.problem("darkroom")',
        "from icrl_dist.problems import registry, gym_adapter",
        'print("see icrl_dist.problems.darkroom for an example")',
        'x = name.startswith("exp")',
    ],
)
def test_what_names_a_problem_without_a_distinction_is_allowed(source: str) -> None:
    assert not violations(source)
