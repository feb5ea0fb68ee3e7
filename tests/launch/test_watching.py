"""The command by which a run is watched can be pasted into a shell."""

import shlex
from pathlib import Path

import pytest
import tyro

from icrl_dist.cli.monitor import MonitorArguments
from icrl_dist.config.sections import StreamConfig
from icrl_dist.launch import watching


def commands(text):
    """The arguments of each command in the text, as the command line reads them."""
    found = [part.partition(" (")[0] for part in text.split(": ")[1:] if part.startswith("icrl-dist monitor ")]
    return [tyro.cli(MonitorArguments, args=shlex.split(part)[2:]) for part in found]


@pytest.mark.parametrize("name", ["runs/demo", "runs/a run; with 'odd' name"])
def test_a_local_run_is_named_by_its_folder(tmp_path, monkeypatch, name):
    monkeypatch.chdir(tmp_path)
    (one,) = commands(watching.hint(StreamConfig(), tmp_path / name, "tcp/127.0.0.1:7447"))
    assert one.what == Path(name) and one.connect is None and one.certificates is None
    (one,) = commands(watching.hint(StreamConfig(), Path("/elsewhere/demo"), "tcp/127.0.0.1:7447"))
    assert one.what == Path("/elsewhere/demo")


@pytest.mark.parametrize(
    ("connect", "endpoint", "reached"),
    [
        ("", "tls/10.0.0.5:7447", "tls/10.0.0.5:7447"),
        ("tls/head:7447", "tls/0.0.0.0:7447", "tls/head:7447"),
        ("", "tls/[fd00::5]:7447", "tls/[fd00::5]:7447"),
    ],
)
def test_a_run_with_certificates_has_a_command_for_each_machine(tmp_path, monkeypatch, connect, endpoint, reached):
    monkeypatch.chdir(tmp_path)
    stream = StreamConfig(endpoint=endpoint, connect=connect, certificates="certs")
    here, away = commands(watching.hint(stream, tmp_path / "runs/demo", endpoint))
    assert (here.what, here.certificates) == (Path("runs/demo"), str(tmp_path / "certs"))
    assert (away.what, away.connect, away.certificates) == (None, reached, str(tmp_path / "certs"))
