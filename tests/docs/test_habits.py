"""The checks of a commit are those of `make check`, the citation is complete, and one version is stated everywhere."""

import re
import tomllib
from pathlib import Path

import yaml

from icrl_dist import __version__
from tests.optional import known


def test_pre_commit_runs_what_make_check_runs():
    checks = known(re.search(r"^check:.*\n((?:\t.*\n)+)", Path("Makefile").read_text(), re.MULTILINE))[1]
    made = [line.strip().removeprefix("$(BIN)/").removesuffix(" .") for line in checks.splitlines()]
    (repository,) = yaml.safe_load(Path(".pre-commit-config.yaml").read_text())["repos"]
    entries = [hook["entry"].removeprefix(".venv/bin/").removesuffix(" --force-exclude") for hook in repository["hooks"]]
    assert entries == made


def test_the_citation_names_the_paper():
    citation = yaml.safe_load(Path("CITATION.cff").read_text())
    assert {"cff-version", "message", "title", "authors", "references"} <= citation.keys()
    (paper,) = citation["references"]
    assert paper["title"].startswith("Efficiently Robust In-Context") and paper["url"].startswith("https://")


def test_the_package_its_metadata_and_the_changelog_state_one_version():
    assert tomllib.loads(Path("pyproject.toml").read_text())["project"]["version"] == __version__
    newest = re.findall(r"^## (.+)$", Path("CHANGELOG.md").read_text(), re.MULTILINE)
    released = [title for title in newest if title != "Unreleased"]
    assert re.fullmatch(rf"{re.escape(__version__)} - \d{{4}}-\d\d-\d\d", released[0])


def test_the_sections_of_the_changelog_are_those_of_keep_a_changelog():
    text = Path("CHANGELOG.md").read_text()
    kinds = "Added", "Changed", "Deprecated", "Removed", "Fixed", "Security"
    assert set(re.findall(r"^### (.+)$", text, re.MULTILINE)) <= set(kinds)
    for section in text.split("\n## ")[1:]:
        before, heading, _ = section.partition("\n### ")
        assert heading and "\n- " not in before
