"""The estimate against numbers computed by hand, and its rates against a run's real time."""

import dataclasses
import json
import subprocess
import sys
import time

import numpy as np
import pytest

from icrl_dist.agent.trained_model import TrainedModel
from icrl_dist.bench import rates as measuring
from icrl_dist.bench.samples import Sample, collected
from icrl_dist.cli import main
from icrl_dist.cli.exit_codes import OK, USAGE
from icrl_dist.config.run import ConfigError, load_run
from icrl_dist.diagnostics.estimate import PhaseRates, Rates, describe, estimate
from icrl_dist.methods import registry as methods
from icrl_dist.problems import registry
from icrl_dist.training import fit
from icrl_dist.training.kernel_fit import KernelFit
from icrl_dist.training.reproducible import best_fit
from tests.calls import noting

PRETRAIN = PhaseRates("pretrain/0", 8, 8000, 800_000, 80_000, 10.0, 1e6, 9e5, 100, 0.5)
ROUND = PhaseRates("adapt/0", 4, 400, 40_000, 0, 30.0, 1000.0, 900.0, 10, 0.5)
RATES = Rates("made-up", "none", 2, (PRETRAIN, ROUND), 200.0, 10**6, 3 * 10**6, 6.0, 12.0)


def test_collecting_is_the_bottleneck_of_one_node():
    plan = estimate(RATES, nodes=1, cores=2, gbit_per_s=10.0)
    # 4 turns of 10 s, against 8000 / 200 = 40 s of ingest and 6.4 s of network; 2 turns of 30 s
    assert [(row["collect_s"], row["limit"]) for row in plan["phases"]] == [(40.0, "collecting"), (60.0, "collecting")]
    assert plan["seconds"] == {
        "collecting": 100.0,
        "jobs": 0.0,
        "ingest": 0.0,
        "network": 0.0,
        "fit": 55.0,
        "evaluation": 12.0,
        "start": 6.0,
    }
    assert plan["hours"] == pytest.approx(173 / 3600) and plan["bottleneck"] == "collecting"
    assert plan["network_bytes"] == 8000 * 10**6 + 400 * 1000 + 2 * 2 * 10**6
    assert plan["disk_bytes"] == 8000 * 9 * 10**5 + 400 * 900 + 2 * 3 * 10**6
    assert plan["env_steps_per_s"] == 840_000 / 200 and plan["labels_per_s"] == 80_000 / 80
    assert plan["useful_workers"] == 8
    assert "2 workers on 1 nodes: 2.9 minutes" in describe(plan) and "first bottleneck: collecting" in describe(plan)


def test_more_nodes_reach_the_next_limit_until_no_node_helps():
    plan = estimate(RATES, nodes=4, cores=2, gbit_per_s=10.0)
    assert [(row["collect_s"], row["limit"]) for row in plan["phases"]] == [(40.0, "ingest"), (30.0, "jobs")]
    assert plan["bottleneck"] == "fit"
    slow = estimate(RATES, nodes=4, cores=2, gbit_per_s=0.1)
    assert slow["phases"][0]["limit"] == "network" and slow["bottleneck"] == "network"
    assert slow["phases"][0]["collect_s"] == pytest.approx((8000 + 8) * 8e6 / 1e8, abs=0.1)
    assert estimate(RATES, 400, 2, 10.0)["hours"] == pytest.approx(plan["hours"], rel=0.05)


@pytest.mark.parametrize(
    ("given", "message"), [((0, 2, 1.0), "--nodes 0"), ((1, 0, 1.0), "--cores 0"), ((1, 2, 0.0), "--gbit 0.0")]
)
def test_a_number_that_is_not_positive_is_refused(given, message):
    with pytest.raises(ConfigError, match=message):
        estimate(RATES, *given)


def test_rates_of_another_machine_are_read(tmp_path, capsys):
    file = tmp_path / "rates.json"
    demo = dataclasses.replace(RATES, run="demo")
    file.write_text("words\n" + json.dumps({"rates": demo.as_dict()}) + "\n")
    assert Rates.read(file, "demo") == demo
    assert main.main(["plan", "demo", "--nodes", "4", "--gbit", "10", "--rates", str(file), "--json"]) == OK
    assert json.loads(capsys.readouterr().out.splitlines()[-1])["bottleneck"] == "fit"
    assert main.main(["plan", "smoke", "--rates", str(file)]) == USAGE
    assert "rates of 'demo', not of 'smoke'" in capsys.readouterr().err
    file.write_text("{}")
    assert main.main(["plan", "demo", "--rates", str(file)]) == USAGE


def test_the_time_of_trials_that_were_not_measured_is_extrapolated():
    spent = np.array([1.0, 2.0, 3.0, 4.0])
    assert measuring._extrapolated(spent, 4, 100) == 10
    assert measuring._extrapolated(spent, 6, 100) == pytest.approx(10 + 5 + 6)
    assert measuring._extrapolated(spent[:1], 3, 100) == pytest.approx(3)  # one was all that there was time for
    assert measuring._extrapolated(spent, 8, 5) == pytest.approx(10 + 5 + 6 + 6 + 6)  # contexts are full


@pytest.mark.parametrize("reproducible", ["auto", "any-machine", "this-machine"])
def test_a_step_of_the_fit_is_timed_as_the_run_takes_it(monkeypatch, reproducible):
    run = load_run("smoke", f"learner.reproducible={reproducible}", "learner.device=cpu")
    if best_fit(run) != "any-machine":
        pytest.skip("the training kernel was not built")
    method, taken = methods.of(run), list[str]()
    trained = TrainedModel(run, method, registry.of(run).spec, method.build(registry.of(run).spec, run))
    phase = method.phases(run)[0]
    data = Sample({phase.stage: collected(run, phase, trained.model)})
    monkeypatch.setattr(KernelFit, "step", noting(taken, lambda *_: "kernel", KernelFit.step))
    monkeypatch.setattr(fit, "fit", noting(taken, lambda *_: "torch", fit.fit))
    assert measuring._fit(trained, phase, data, 0.0) > 0
    assert set(taken) == {"torch" if reproducible == "this-machine" else "kernel"}


SHORT = [
    "pretrain.steps=40",
    "icaa.trials=5",
    "icaa.context_trials=2",
    "icaa.steps=15",
    "evaluate.seeds=1",
    "evaluate.episodes=5",
]

MEASURE = """
import json, sys
from icrl_dist.bench import rates
from icrl_dist.config.run import load, override
print(json.dumps(rates.measure(override(load("demo"), sys.argv[1:], "test"), "demo", budget_s=1.0).as_dict()))
"""


@pytest.mark.integration
def test_the_demo_takes_the_estimated_time(tmp_path):
    """Within a factor of two, with the demo's room, model, tasks, adversaries and batches, but fewer steps and trials.

    Other tests run at the same time.  So on failure the rates are measured again after the run, and
    then the whole comparison is repeated once.
    """
    settings = [*SHORT, "learner.threads=1"]
    words = [word for setting in settings for word in ("--set", setting)]

    def estimated():
        given = [sys.executable, "-c", MEASURE, *settings]  # in another process, without the shape checks of the tests
        found = json.loads(subprocess.run(given, check=True, capture_output=True, text=True).stdout)
        assert len(found["phases"]) == 4 and found["phases"][1]["trajectories"] == 18 * 9 * 6
        rates = Rates(**{**found, "phases": tuple(PhaseRates(**phase) for phase in found["phases"])})
        return 3600 * estimate(rates, nodes=1, cores=1, gbit_per_s=1.0)["hours"]

    command = [sys.executable, "-m", "icrl_dist.cli", "train", "demo", "--engine", "inline", "--out", tmp_path / "demo"]
    before, seen = estimated(), []
    for _ in range(2):
        began = time.monotonic()
        subprocess.run([*command, "--overwrite", *words], check=True, stdout=subprocess.DEVNULL)
        real = time.monotonic() - began
        after = before if before / 2 < real < 2 * before else estimated()  # the speed of the machine may have changed
        seen.append((before, real, after))
        if min(before, after) / 2 < real < 2 * max(before, after):
            return
        before = after
    raise AssertionError(f"estimated, taken, estimated again: {seen}")
