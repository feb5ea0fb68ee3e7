"""Links, paths and identifiers in the documentation exist."""

import re
from pathlib import Path

import pytest

PAGES = [Path("README.md"), Path("CONTRIBUTING.md"), *sorted(Path("docs").rglob("*.md"))]
DECISIONS = [page for page in sorted(Path("docs/decisions").glob("*.md")) if "*Status: replaced" not in page.read_text()]
"""Without those that are replaced, which keep the names of their time."""
OF_CODE = [Path("CONTRIBUTING.md"), Path("docs/architecture.md"), Path("docs/glossary.md"), *DECISIONS]
ROOTS = Path("icrl_dist"), Path()


@pytest.mark.parametrize("page", PAGES, ids=str)
def test_every_relative_link_leads_to_a_file(page: Path) -> None:
    targets = re.findall(r"\]\(([^)#\s]+)[^)]*\)", page.read_text())
    relative = [target for target in targets if not re.match(r"[a-z]+:", target)]
    missing = [target for target in relative if not (page.parent / target).exists()]
    assert not missing, f"{page}: {missing}"


@pytest.mark.parametrize("page", OF_CODE, ids=str)
def test_every_path_of_the_code_exists(page: Path) -> None:
    named = set(re.findall(r"`((?:[\w-]+/)+[\w-]+\.(?:py|json|toml|yaml))`", page.read_text()))
    paths = {name for name in named if "NAME" not in name}
    missing = sorted(name for name in paths if not any((root / name).exists() for root in ROOTS))
    assert not missing, f"{page}: {missing}"


def test_every_identifier_of_the_glossary_is_in_its_file() -> None:
    found = re.findall(r"`([A-Za-z_.]+)` in `([\w/]+\.py)`", Path("docs/glossary.md").read_text())
    assert len(found) > 30
    missing = []
    for name, path in found:
        source = next((root / path).read_text() for root in ROOTS if (root / path).exists())
        if not re.search(rf"\b{name.rpartition('.')[2]}\b", source):
            missing.append(f"{name} in {path}")
    assert not missing


def test_every_key_of_the_glossary_is_one_of_the_run_file() -> None:
    from icrl_dist.config.run import run_type

    run = run_type(None)()
    sections = r"adversary|pretrain|dagger|icaa|model|optim|context|evaluate|stream|learner|control|darkroom|sac|alerts"
    keys = re.findall(rf"`({sections})\.(\w+)[^`]*`", Path("docs/glossary.md").read_text())
    assert len(keys) > 15
    missing = [f"{section}.{key}" for section, key in keys if not hasattr(run.section(section), key)]
    assert not missing


def test_every_decision_is_in_the_index() -> None:
    folder = Path("docs/decisions")
    index = (folder / "README.md").read_text()
    missing = [page.name for page in sorted(folder.glob("*.md")) if page.name != "README.md" and f"]({page.name})" not in index]
    assert not missing
