"""Every suite of ``icrl-dist evaluate`` with the corridor of ``tests/toys``, and with variants that lack or have more."""

import json

import numpy as np
import pytest
import torch

from icrl_dist.cli import main
from icrl_dist.interfaces import Reference
from icrl_dist.methods import registry as methods
from icrl_dist.methods.icag import ICAG
from icrl_dist.models.weights import weights_of
from icrl_dist.problems import registry
from icrl_dist.rollout.policies import RandomPolicy
from icrl_dist.storage.checkpoint import Checkpoint, save_checkpoint, version_file
from icrl_dist.types import Step
from learner import checkpoints
from tests.toys.corridor import Corridor, CorridorProblem


class Exact:
    """Exact answers of a corridor in which every return is 0."""

    def optimum(self, variations):
        return np.zeros(len(variations))

    def agent(self, run, rule):
        return lambda rows, env: RandomPolicy(2)


RANDOM = Reference(lambda rows, env: RandomPolicy(2))
TOLD = Reference(lambda rows, env: RandomPolicy(2), ceiling=True)


def corridor(reward=None, references=None, **parts):
    """A corridor in which each step gives this reward, with these references and optional parts."""

    class Env(Corridor):
        def step(self, actions):
            step = super().step(actions)
            rewards = step.reward if reward is None else np.full(self.batch, reward, np.float32)
            return Step(step.observation, rewards, step.done, step.adversary)

    made = {"batch": lambda self, variations: Env(variations), **parts}
    if references is not None:
        made["references"] = lambda self, run: references
    return type("Variant", (CorridorProblem,), made)


@pytest.fixture
def suite(toy_run, tmp_path, capsys):
    """``suite(name, problem, method)``: exit code, the JSON answer or None, and what was printed for people."""

    def evaluate(name, problem=CorridorProblem, method="icag"):
        run = toy_run(problem=problem, method=method)
        torch.manual_seed(0)
        spec = registry.of(run).spec
        arrays = {f"model/{key}": value for key, value in weights_of(methods.of(run).build(spec, run)).items()}
        save_checkpoint(version_file(tmp_path, 0), Checkpoint(arrays, checkpoints.manifest(run, spec, 0, 1)))
        code = main.main(["evaluate", str(tmp_path), "--suite", name, "--json"])
        printed = capsys.readouterr()
        return code, json.loads(printed.out.splitlines()[-1]) if printed.out else None, printed.err

    return evaluate


def agents(answer):
    return [row["agent"] for row in answer["rows"] if row["p"] == 0]


@pytest.mark.parametrize("method", ["icag", "return-to-go"])
def test_online_and_offline_need_no_exact_answers(suite, method):
    model = f"T^0 ({method})"
    code, answer, _ = suite("online", method=method)
    assert code == 0 and agents(answer) == [model, "random"]
    code, answer, _ = suite("offline", method=method)
    takes_data = method == "icag"
    assert code == 0 and agents(answer) == ["random data", *([f"{model}, random data"] if takes_data else [])]
    assert all(row["optimum"] is None for row in answer["rows"])


def test_online_needs_no_references(suite):
    code, answer, _ = suite("online", corridor(references={}))
    assert code == 0 and agents(answer) == ["T^0 (icag)"]


@pytest.mark.parametrize("reward", [0.0, -1.0])
def test_returns_of_0_and_below_are_shown(suite, reward):
    references = {"random": RANDOM, "told": TOLD}
    for problem in (corridor(reward), corridor(reward, references, exact=Exact())):
        for name in ("online", "offline"):
            code, answer, _ = suite(name, problem)
            assert code == 0 and {row["last5"] for row in answer["rows"]} == {8 * reward}
    first = {p: answer["first10_over_oracle"][p] for answer in [suite("online", problem)[1]] for p in ("0", "0.2")}
    assert first == dict.fromkeys(("0", "0.2")), "no share of a return that is not above 0"


@pytest.mark.parametrize(("name", "source"), [("random", "random"), ("told", "expert")])
def test_offline_has_the_data_that_the_references_can_collect(suite, name, source):
    code, answer, _ = suite("offline", corridor(references={name: RANDOM if name == "random" else TOLD}))
    assert code == 0 and agents(answer) == [f"{source} data", f"T^0 (icag), {source} data"]


@pytest.mark.parametrize("references", [{}, {"other": RANDOM}])
def test_offline_without_a_source_of_data_is_refused(suite, references):
    code, answer, line = suite("offline", corridor(references=references))
    assert code == 2 and answer is None and len(line.splitlines()) == 1
    assert "--suite offline: toy-corridor has no reference 'random' and none that is given the task" in line


class NoDistributions(ICAG):
    name = "none-given"

    def distributions(self, model, transitions, queries, prefix):
        return None


class Posterior:
    kinds, priors = ("walk",), {"": "own", "_any": "any"}

    def levels(self, run):
        return (0.0,)

    def divergences(self, run, decide, act, heldout):
        shown, actions = np.zeros((1, 1, 1), np.float32), np.zeros((1, 1), int)
        yield decide((shown, actions, shown, np.zeros((1, 1), np.float32)), shown, actions)


@pytest.mark.parametrize(
    ("parts", "method", "reason"),
    [
        ({}, "icag", "toy-corridor with icag has no exact posterior"),
        ({"exact": Exact()}, "icag", "toy-corridor with icag has no exact posterior"),
        ({"posterior": Posterior()}, "icag", "toy-corridor has no exact answers"),
        ({"posterior": Posterior(), "exact": Exact()}, "return-to-go", "toy-corridor with return-to-go has no exact posterior"),
        ({"posterior": Posterior(), "exact": Exact()}, "none-given", "the model of none-given gives no distributions"),
    ],
)
def test_the_posterior_suite_is_refused_without_the_parts_that_it_needs(suite, install, parts, method, reason):
    install(methods={"none-given": NoDistributions})
    code, answer, line = suite("posterior", corridor(**parts), method)
    assert code == 2 and answer is None and len(line.splitlines()) == 1
    assert f"--suite posterior: {reason}" in line and line.rstrip().endswith("use --suite online")
