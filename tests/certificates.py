"""Certificates for a test, made by the script that users run."""

import os
import shutil
import subprocess
from pathlib import Path

import pytest

ZENOH = Path(__file__).parents[1] / "deploy" / "zenoh"


def make(folder: Path, *hosts: str, days: int = 7) -> str:
    """A folder of certificates by an authority of its own (or the one that is there already)."""
    if shutil.which("openssl") is None:
        pytest.skip("no openssl: certificates cannot be made")
    command = [str(ZENOH / "certificates.sh"), str(folder), *hosts]
    made = subprocess.run(command, capture_output=True, text=True, check=False, env={**os.environ, "DAYS": str(days)})
    assert made.returncode == 0, made.stderr
    return str(folder)
