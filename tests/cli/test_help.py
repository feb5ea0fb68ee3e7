"""Help fits into the terminal, in paragraphs, with examples that can be copied."""

import itertools
import re

import pytest

from icrl_dist.cli import main


@pytest.mark.parametrize("command", ["", *main.COMMANDS])
@pytest.mark.parametrize("width", [80, 120])
def test_help_fits_and_breaks_no_sentence_early(capsys, monkeypatch, command, width):
    monkeypatch.setenv("COLUMNS", str(width))
    if command:
        with pytest.raises(SystemExit):
            main.main([command, "--help"])
    else:
        main.main(["--help"])
    lines = re.sub(r"\x1b\[[0-9;]*m", "", capsys.readouterr().out).splitlines()
    assert all(len(line) <= width for line in lines if not line.startswith("usage:"))
    texts = [line.strip("│").rstrip() for line in lines if line.startswith("│ ")]
    for line, following in itertools.pairwise(texts):
        indent, first = re.match(r" *", line)[0], following.split()[:1]  # type: ignore[index]
        goes_on = len(indent) > 4 and following.startswith(indent) and not following[len(indent) :].startswith(" ")
        if goes_on and first and not line.endswith(")"):
            assert len(line) + 1 + len(first[0]) > width - 4, (line, following)


def test_an_example_is_on_one_line(capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", "80")
    with pytest.raises(SystemExit):
        main.main(["train", "--help"])
    assert "``icrl-dist train demo --method icag --adversary.count 4``" in capsys.readouterr().out
