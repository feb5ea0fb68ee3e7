"""Text from outside is plain wherever it is shown: one line, bounded, printable, never markup."""

import io
import json
import re
import unicodedata

import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from icrl_dist.cli import main
from icrl_dist.console.display import Display
from icrl_dist.console.terminal import PlainConsole
from icrl_dist.monitor import lines, validation
from icrl_dist.stream.excerpts import plain, plain_lines

HOSTILE = "[/x] [red]a[/red] :bomb: \x1b]52;c;ZXZpbA==\x07 \x1b[2J \x9b31m \u202eslat \ud800 e\u0301\u0301 \x00 a\r\nb\t\u2028"
ANY = st.text(st.characters(), max_size=300)
"""Also lone surrogates and control characters."""
_OWN_CODES = re.compile(r"\x1b\[[0-9;?]*[A-Za-z]")
"""The codes with which rich draws bars; an attack would need another kind (OSC), or these in a text without a terminal."""


def is_plain(text):
    return text.isprintable() and not any(unicodedata.category(c) in ("Mn", "Me") for c in text)


@given(ANY, st.integers(3, 400))
@example(HOSTILE, 400)
def test_any_text_becomes_one_bounded_printable_line(text, longest):
    shown = plain(text, longest)
    assert is_plain(shown) and len(shown) <= longest and plain(shown, longest) == shown
    assert shown.encode("utf-8").decode() == shown
    if text.isascii() and text.isprintable() and len(text) <= longest:
        assert shown == text


@given(ANY)
@example(HOSTILE)
def test_several_lines_stay_lines(text):
    shown = plain_lines(text)
    assert [plain(line, 1 + len(line) * 2) for line in text.split("\n")] == shown.split("\n")


def progress_event(text):
    counts = {"round": 0, "step": 3, "steps": 9, "version": 0, "workers": 2, "lag": 0, "per_s": 1.0, "drops": {}}
    return {"event": "progress", "stage": "collect", "phase": "adapt", **counts, "doing": [text]}


@pytest.mark.parametrize("terminal", [False, True])
@settings(deadline=None, max_examples=50)
@given(text=ANY)
@example(text=HOSTILE)
def test_the_display_shows_any_text_of_an_event(terminal, text):
    output = io.StringIO()
    console = PlainConsole(file=output, force_terminal=terminal, width=4000, color_system=None)
    with Display(console) as display:
        for kind in ("note", "worker", "crash", "quarantine"):
            display.report({"event": kind, "text": f"it says {text}"})
        display.report(progress_event(text))
        display.report(progress_event(f"more {text}"))
    written = _OWN_CODES.sub("", output.getvalue()) if terminal else output.getvalue()
    assert is_plain("".join(c for c in written if c not in "\n\r"))
    if not terminal:
        assert any(line.rstrip().endswith(f"it says {plain(text, 1000)}".rstrip()) for line in written.splitlines())


def test_markup_of_an_event_is_shown_and_not_executed():
    output = io.StringIO()
    Display(PlainConsole(file=output, width=200)).report(progress_event("w0: [/x] [red]at[/red] :bomb:"))
    assert "w0: [/x] [red]at[/red] :bomb:" in output.getvalue()


@given(ANY)
@example(HOSTILE)
def test_the_views_show_any_text(text):
    shown = validation.text(text, 100)
    assert is_plain(shown) and len(shown) <= 100
    assert is_plain(lines.safe(text))


def test_an_error_that_quotes_a_file_or_a_peer_is_printed_plain(capsys, tmp_path):
    folder = tmp_path / "\x1b]52;c;ZXZpbA==\x07[bold]"
    folder.mkdir()
    (folder / "run.toml").write_text('problem = "\\u001b[2J[/x]"\n')
    for words in (["explain", str(folder)], ["train", str(folder / "run.toml")], ["tap", str(folder / "none")]):
        assert main.main(words) == 2
        (line,) = capsys.readouterr().err.splitlines()
        assert is_plain(line)


@pytest.mark.parametrize("encoding", ["ascii", "latin-1", "utf-8"])
def test_a_terminal_of_any_encoding_shows_any_text(encoding, monkeypatch):
    written = io.BytesIO()
    monkeypatch.setattr("sys.stdout", io.TextIOWrapper(written, encoding, write_through=True))

    def say(_, console):
        console.print(HOSTILE + "\u4e2d")
        return 0

    monkeypatch.setattr(main, "COMMANDS", {"plan": (main.COMMANDS["plan"][0], say)})
    assert main.main(["plan", "smoke"]) == 0
    shown = written.getvalue().decode(encoding)
    assert "[/x]" in shown and is_plain(shown.replace("\n", ""))
    assert ("\u4e2d" in shown) is (encoding == "utf-8")


def test_json_escapes_what_it_prints():
    assert json.dumps({"worker": HOSTILE}).isprintable()
