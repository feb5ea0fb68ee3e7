"""The Python example of the README runs unchanged."""

import contextlib
import io
import re
from pathlib import Path

from tests.optional import known


def test_the_example_runs_and_prints_ten_returns():
    (code,) = re.findall(r"```python\n(.*?)```", Path("README.md").read_text(), re.DOTALL)
    printed = io.StringIO()
    with contextlib.redirect_stdout(printed):
        exec(code, {})
    lines = printed.getvalue().splitlines()
    assert [int(known(re.fullmatch(r"episode (\d+): return \d+", line))[1]) for line in lines] == list(range(1, 11))
