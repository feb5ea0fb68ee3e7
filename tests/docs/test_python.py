"""The examples of docs/python.md run, in their order, and show what the page says."""

import dataclasses
import re
from pathlib import Path

import pytest

EXAMPLES = re.findall(r"```python\n(.*?)```", Path("docs/python.md").read_text(), re.DOTALL)


@dataclasses.dataclass(frozen=True)
class MyConfig:
    """Settings of the problem of the page."""


@pytest.fixture(scope="module")
def shown(tmp_path_factory):
    """What each example printed, and the names that all of them have set."""
    import contextlib
    import io

    names, printed = {"MyConfig": MyConfig}, []
    with contextlib.chdir(tmp_path_factory.mktemp("python")):
        for example in EXAMPLES:
            with contextlib.redirect_stdout(io.StringIO()) as output:
                exec(example, names)
            printed.append(output.getvalue())
    return printed, names


def test_every_example_runs_and_prints(shown):
    printed, names = shown
    train, evaluate, results, compare, sweep, trajectories, agent, problem = printed
    assert "worker w0 joined" in train and "T^2 (icaa)" in train, "progress, then the table"
    assert "random" in evaluate and re.search(r"^0\.3 +\d", evaluate, re.MULTILINE)
    assert "training_seed" in results and "worker w0 joined" not in results, "no progress unless it is asked for"
    assert "2 training seeds" in " ".join(compare.split()) and "ICAG" in compare
    assert re.fullmatch(r"small \d+ rows; 0 failed\n", sweep)
    trained = 280 + 2 * 7 * 2 * 16  # contexts; rounds, tasks, variations, trials
    assert trajectories.startswith(f"{trained} trajectories") and len(names["one"]) == 9
    assert re.findall(r"episode (\d): return \d", agent) == list("12345")
    assert problem == ""


def test_the_problem_of_the_page_has_every_required_method(shown):
    _, names = shown
    assert names["MyProblem"]("mine", MyConfig()).name == "mine", "no abstract method is left"
    listed = set(re.findall(r"def (\w+)\(", EXAMPLES[-1]))
    assert listed == names["icrl_dist"].Problem.__abstractmethods__
