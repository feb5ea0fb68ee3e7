"""Every block of docs/security.md names the tests that show it, and the tests exist; nothing unpickles but what is listed."""

import ast
import re
from pathlib import Path

from icrl_dist.monitor import event_stream
from icrl_dist.stream import admission
from icrl_dist.telemetry import crash_reports
from learner import known_workers

ROOT = Path(__file__).parents[2]
PAGE = (ROOT / "docs" / "security.md").read_text()
_MARK = re.compile(r"<!-- (?:(?P<advice>advice)|(?P<file>[a-z0-9_]+/test_[a-z0-9_]+\.py): (?P<tests>[a-z0-9_, ]+)) -->")
RAY = {"Ray"}
"""Sections about another program, which tests here cannot show."""
UNPICKLES = {"icrl_dist/problems/metaworld/environment.py"}
"""Files that unpickle: what ML1 has pickled in the same process."""


def blocks():
    """(section, block, marks) of the page: a block is a paragraph, a list or a table, with the marks at its end."""
    section = ""
    without_code = re.sub(r"```.*?```", "", PAGE, flags=re.DOTALL)
    for block in re.split(r"\n\s*\n", without_code):
        if block.startswith("#"):
            section = block.lstrip("# ").splitlines()[0]
        elif block.strip() and not block.startswith("<!-- After each block"):
            yield section, block, list(_MARK.finditer(block))


def functions_of(file):
    tree = ast.parse((ROOT / "tests" / file).read_text())
    return {node.name for node in ast.walk(tree) if isinstance(node, ast.FunctionDef)}


def test_every_block_names_its_tests_or_is_advice():
    unmarked = [block[:80] for section, block, marks in blocks() if not marks and section not in RAY]
    assert not unmarked


def test_the_tests_that_the_page_names_exist():
    named = [
        (mark["file"], name) for _, _, marks in blocks() for mark in marks if mark["file"] for name in mark["tests"].split(", ")
    ]
    assert len(named) > 40
    assert not [(file, name) for file, name in named if name not in functions_of(file)]
    comments = re.findall(r"<!--.*?-->", PAGE)
    assert [one for one in comments if not _MARK.fullmatch(one)] == [comments[0]], "a mark is misspelt"


def test_the_limits_are_those_of_the_program():
    table = PAGE.partition("## Limits")[2].partition("## ")[0]
    limits = [admission._MOST_DESCRIPTORS, admission._RESERVE, admission.MAX_PENDING, admission.MAX_SESSIONS]
    limits += [admission.MAX_MONITORS, known_workers.MAX_WORKERS, crash_reports.MAX_FILES, event_stream.MAX_VIEWERS]
    assert not [limit for limit in limits if not re.search(rf"(?<![\d,]){limit:,}(?![\d,]*\d)", table)]


def test_nothing_else_is_unpickled():
    found = set()
    for package in ("icrl_dist", "actors", "learner", "tools"):
        for path in (ROOT / package).rglob("*.py"):
            text = path.read_text()
            loads = [call for call in re.findall(r"torch\.load\([^\n]*", text) if "weights_only=True" not in call]
            unsafe = re.search(
                r"pickle\.loads?\(|allow_pickle=True|joblib|yaml\.(unsafe_)?load\(|marshal\.|\bSAC\.load\(|shelve", text
            )
            if loads or (unsafe and not text[: unsafe.start()].count("``") % 2):
                found.add(str(path.relative_to(ROOT)))
    assert found == UNPICKLES
