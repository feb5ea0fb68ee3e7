"""Every command in the documentation is one that a shell and the command line accept."""

import functools
import re
from pathlib import Path

import pytest

from icrl_dist.cli import main
from icrl_dist.cli.plan import PlanArguments
from icrl_dist.cli.train import TrainArguments
from icrl_dist.config.run import ConfigError, load, override, validate
from icrl_dist.config.toml import dumps
from tests.docs.shell_commands import Command, ShellError, blocks, calls, comments, filled, spans

ROOT = Path.cwd()
PAGES = [
    Path("README.md"),
    Path("CONTRIBUTING.md"),
    *sorted(Path("docs").glob("*.md")),
    *sorted(Path("docs/results").glob("*.md")),
]
CLUSTERS = [*sorted(Path("deploy/clusters").glob("*.yaml")), *sorted(Path("deploy/batch").iterdir())]
SOURCES = sorted(Path("icrl_dist/cli").glob("*.py"))
COMMAND_PAGE = Path("docs/commands.md")


@functools.cache
def fault(*call: str) -> str:
    """Why a call of ``icrl-dist`` is refused before it does anything; empty if it is not."""
    if len(call) < 2:
        return ""
    name, words = call[1], call[2:]
    left = [word for word in call if re.search(r"(?<![\w$])[A-Z][A-Z_]{2,}(?!\w)", word)]
    if left:
        return f"no value for the placeholder in {left}"
    if name in ("--help", "--version"):
        return ""
    if name not in main.COMMANDS:
        return f"no command {name}"
    try:
        arguments = main._parse(name, words)
        if isinstance(arguments, TrainArguments):
            validate(override(arguments.config, arguments.set, "--set"), arguments.run)
        if isinstance(arguments, PlanArguments):
            override(load(arguments.run), arguments.set, "--set")
    except ConfigError as error:
        return str(error)
    except SystemExit as ended:
        return f"exit code {ended.code}" if ended.code else ""
    return ""


def faults(commands: list[Command], folder: Path) -> list[str]:
    """What is wrong with these commands, a line each."""
    found = []
    mentions = {command for command in commands if re.fullmatch(r"icrl-dist [\w-]+", command.text)}
    for command in commands:
        if command in mentions:  # the name of a command, without its arguments
            wrong = [] if command.text.split()[1] in (*main.COMMANDS, "COMMAND") else [f"no command: {command.text}"]
        else:
            try:
                called = calls(filled(command.text), folder)
            except ShellError as error:
                called, wrong = [], [str(error)]
            else:
                wrong = [f"{' '.join(call)}: {why}" for call in called if call[0] == "icrl-dist" and (why := fault(*call))]
            targets = [word for call in called if call[0] == "make" for word in call[1:] if "=" not in word]
            wrong += [
                f"no target: make {target}" for target in targets if f"\n{target}:" not in (ROOT / "Makefile").read_text()
            ]
            files = [word for call in called for word in call if re.match(r"deploy/[\w/.-]+$", word)]
            wrong += [f"no file {file}" for file in files if not (ROOT / file).exists()]
        found += [f"line {command.line}: {why}" for why in wrong]
    return found


@pytest.fixture
def runs(tmp_path, monkeypatch):
    """A folder to work in: with the run folder ``runs/demo``, which ``--from`` reads, and the files named on pages."""
    checkpoints = tmp_path / "runs" / "demo" / "checkpoints"
    checkpoints.mkdir(parents=True)
    (checkpoints / "version-0000.npz").touch()
    (checkpoints.parent / "run.toml").write_text(dumps(load("demo")))
    for name in ("my_package/runs/small.toml", "my-run.toml"):
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text(dumps(load("smoke")))
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.mark.parametrize("page", PAGES, ids=str)
def test_every_command_of_a_page_is_accepted(page, runs):
    text = (ROOT / page).read_text()
    assert not faults([*blocks(text), *spans(text)], runs), page


@pytest.mark.parametrize("page", CLUSTERS, ids=str)
def test_every_command_in_the_comments_of_a_file_is_accepted(page, runs):
    text = comments((ROOT / page).read_text())
    assert blocks(text), "the file says how it is used"
    assert not faults([*blocks(text), *spans(text)], runs), page


@pytest.mark.parametrize("source", SOURCES, ids=str)
def test_every_command_in_the_texts_of_the_command_line_is_accepted(source, runs):
    assert not faults(spans((ROOT / source).read_text()), runs), source


@pytest.mark.parametrize(
    ("page", "expected"),
    [
        ("```sh\nray exec FILE 'icrl-dist train demo --address auto\n  --actors 2'\n```", "--actors: command not found"),
        ("\n    icrl-dist train demo \\\n        --no-such-option 1\n", "exit code 2"),
        ("| `icrl-dist train demo --set adversary.cuont=4` |", "adversary.cuont"),
        ("`icrl-dist train demo --adversary.p-max 3`", "adversary.p_max"),
        ("`icrl-dist trian`", "no command"),
        ("`icrl-dist evaluate UNKNOWN`", "placeholder"),
        ("```sh\nicrl-dist train 'demo\n```", "exit code 2"),
        ("```sh\nmake deom\n```", "no target"),
    ],
)
def test_a_wrong_command_is_found(page, expected, runs):
    (found,) = faults([*blocks(page), *spans(page)], runs)
    assert expected in found


@pytest.mark.parametrize("page", PAGES, ids=str)
def test_every_block_names_its_language(page):
    opening = re.findall(r"(?m)^\s*```(.*)$", page.read_text())[::2]
    assert all(opening), "tag blocks of commands as sh, so that they are tested"


def sections() -> dict[str, str]:
    """The text about each command, by the command's name."""
    parts = re.split(r"(?m)^## (.+)$", COMMAND_PAGE.read_text())
    return dict(zip(parts[1::2], parts[2::2], strict=True))


def test_the_page_of_commands_lists_and_explains_every_command():
    listed = re.findall(r"(?m)^\| \[`icrl-dist (\w+)`\]\(#\1\)", COMMAND_PAGE.read_text())
    assert sorted(listed) == sorted(main.COMMANDS)
    assert list(sections()) == listed, "in the order of the table"


@pytest.mark.parametrize("name", main.COMMANDS)
def test_the_page_of_commands_shows_an_example_and_names_only_real_options(name, capsys):
    text = sections()[name]
    assert any(f"icrl-dist {name} " in block.text or f"icrl-dist {name}\n" in block.text for block in blocks(text))
    with pytest.raises(SystemExit):
        main._parse(name, ["--help"])
    help_text = capsys.readouterr().out
    named = {option for span in re.findall(r"`([^`]+)`", text) for option in re.findall(r"--[a-z][\w.-]*", span)}
    assert not [option for option in named if not re.search(rf"(?<!\S){re.escape(option)}(?![\w.-])", help_text)]
