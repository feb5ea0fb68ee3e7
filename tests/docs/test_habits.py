"""The checks of a commit are those of `make check`, and the citation is complete."""

import re
from pathlib import Path

import yaml

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
