"""The commands that show a run, for its terminal."""

from __future__ import annotations

import os
import shlex
import socket
from pathlib import Path

from icrl_dist.config.sections import StreamConfig
from icrl_dist.stream import endpoints, security


def hint(stream: StreamConfig, folder: Path, endpoint: str) -> str:
    """How to watch the run in ``folder``, whose learner listens at ``endpoint``: complete commands for a shell."""
    here = [_shown(folder), *_certificates(stream)]
    text = f"watch this run: {_command(here)} (in a browser: add --web 8000)"
    reached = endpoints.parse(stream.connect or endpoint)
    if reached.loopback:
        return text
    host = socket.gethostname() if reached.everywhere else reached.host
    connect = f"{reached.protocol}/{f'[{host}]' if ':' in host else host}:{reached.port}"
    away = ["--connect", connect, *_certificates(stream)]
    return f"{text}; from another machine that has these certificates: {_command(away)}"


def _command(words: list[str]) -> str:
    return shlex.join(["icrl-dist", "monitor", *words])


def _shown(folder: Path) -> str:
    """The folder's path from the current folder if it is inside, else its absolute path."""
    path = os.path.relpath(folder)
    return str(folder.absolute()) if path.startswith("..") else path


def _certificates(stream: StreamConfig) -> list[str]:
    """The option for certificates, with an absolute path, because the run file's path may begin at another folder."""
    return ["--certificates", security.folder(stream.certificates)] if stream.certificates else []
