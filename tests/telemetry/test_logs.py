"""Log lines carry the time in UTC, and log files stay small."""

import logging
import re
import subprocess
import sys

import pytest

from icrl_dist.telemetry import logs
from icrl_dist.telemetry.budget import LogLines
from icrl_dist.telemetry.stamps import stamp

TIME = r"\d{4}-\d\d-\d\dT\d\d:\d\d:\d\dZ"


def test_the_time_is_in_utc_whatever_the_zone_of_the_machine(monkeypatch):
    monkeypatch.setenv("TZ", "Asia/Tokyo")
    assert stamp(0.0) == "1970-01-01T00:00:00Z"
    record = logging.LogRecord("x", logging.INFO, "x.py", 1, "resent %d", (3,), None)
    record.created = 86_400.5
    assert LogLines().format(record) == "1970-01-02T00:00:00Z resent 3"


def test_a_full_file_of_standard_error_is_moved_while_its_writer_writes_on(tmp_path, monkeypatch):
    monkeypatch.setattr(logs, "MAX_BYTES", 100)
    path = tmp_path / "learner.err"
    with path.open("ab", buffering=0) as writer:
        for number in range(40):
            writer.write(b"line %02d\n" % number)
            logs.bound(path)
    older = tmp_path / "learner.err.1"
    assert {file.name for file in tmp_path.iterdir()} == {path.name, older.name}
    assert path.stat().st_size <= 110 and older.stat().st_size <= 110
    assert (older.read_bytes() + path.read_bytes()).endswith(b"line 37\nline 38\nline 39\n")
    logs.bound(tmp_path / "missing")


@pytest.mark.integration
def test_log_lines_warnings_and_tracebacks_of_a_process_have_the_time(tmp_path):
    program = f"""
import logging, threading, warnings
from pathlib import Path
from icrl_dist.telemetry import logs
logs.MAX_BYTES = 2000
logs.log_to(Path({str(tmp_path / "learner.log")!r}))
for number in range(90):
    logging.getLogger("learner").info("message %d", number)
    logging.getLogger("learner").info("further message %d", number)
warnings.warn("an old name")
thread = threading.Thread(target=lambda: 1 / 0)
thread.start()
thread.join()
raise SystemError("the end")
"""
    ran = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=False)
    assert len(re.findall(rf"^{TIME}\n(Exception in|Traceback)", ran.stderr, re.M)) == 2 and ran.returncode == 1
    assert {file.name for file in tmp_path.iterdir()} == {"learner.log", "learner.log.1", "learner.log.2"}
    lines = (tmp_path / "learner.log").read_text()
    assert re.search(rf"^{TIME} message 89$", lines, re.M) and "an old name" in lines
