"""Strengths given as a drop of the return: the solver on known functions, and the tables that store its results."""

import functools
import json
import math

import numpy as np
import pytest

from icrl_dist.bench import disturbance, drop
from icrl_dist.bench.disturbance import DisturbanceSizes
from icrl_dist.cli import main
from icrl_dist.config.run import ConfigError, dumps, load, override, parse
from icrl_dist.problems import registry
from icrl_dist.problems.continuous import calibrated_strength
from icrl_dist.problems.continuous.disturbance import Setting
from icrl_dist.problems.dmc import domains
from icrl_dist.types import Variation
from tests.bench.test_bench_disturbance import Balances

KIND = "dmc-cartpole-balance"
RUN = f'problem = "{KIND}"\n[control]\ntrain_tasks = 4\nstrength = "drop:0.3"\n'


def row(strength, problem=KIND, forces=("paper",), share=0.3, meters=0.0):
    return {"problem": problem, "forces": list(forces), "meters": meters, "drop": share, "strength": strength}


@pytest.fixture
def own(tmp_path, monkeypatch):
    """The user's own table, in a folder of the test."""
    file = tmp_path / "cache" / "drops.json"
    monkeypatch.setattr(calibrated_strength, "own_file", lambda: file)
    monkeypatch.setattr(calibrated_strength, "packaged", list)

    def put(*rows):
        file.parent.mkdir(exist_ok=True)
        file.write_text(json.dumps(rows))
        return file

    return put


@pytest.mark.parametrize("slope", [0.001, 0.04, 0.7, 90.0])
def test_a_straight_line_is_solved_to_the_tolerance_from_above(slope):
    found = drop.solve(lambda strength: slope * strength, 0.25, most=2.0**12)
    exact = 0.25 / slope
    assert found.reached and exact <= found.strength <= exact / (1 - 0.021) and found.lost == slope * found.strength
    assert list(found.tried) == sorted(found.tried) and (found.strength, found.lost) in found.tried


def test_the_smallest_strength_is_found_for_a_loss_that_rises_and_falls():
    def bump(s):
        """Passes 0.25 three times."""
        return 0.5 * math.exp(-((math.log(s) - math.log(3.0)) ** 2)) + 0.01 * s

    fine = np.geomspace(drop.FIRST, drop.MOST, 20_001)
    slow = next(s for s in fine if bump(s) >= 0.25)
    found = drop.solve(bump, 0.25)
    assert slow * 0.999 <= found.strength <= slow * 1.022
    assert any(bump(s) < 0.25 for s in fine if s > found.strength), "the loss is not monotone"


def test_a_drop_that_no_strength_reaches_is_reported_at_the_largest_strength():
    found = drop.solve(lambda strength: 0.2, 0.25, first=1.0, most=6.0)
    assert not found.reached and found.strength == 6.0 and [s for s, _ in found.tried] == [1, 2, 4, 6]


def test_a_run_has_the_measured_strength_and_keeps_it_when_the_table_changes(own):
    own(row(7.5), row(9.0, forces=("qarl",)), row(1.0, share=0.25), row(2.0, problem="dmc-cheetah-run"))
    run = parse(RUN, "file")
    control = run.section("control")
    assert control.strength == "drop:0.3" and calibrated_strength.strength(control, run.problem) == 7.5
    pushes = {v.adversary["strength"] for v in registry.training_variations(run, 0, registry.of(run).split.train[0])[1:]}
    assert pushes == {7.5} and registry.test_adversary(run, 0, 2.0, "unseen")["strength"] == 15.0
    own(row(8.0), row(9.0, forces=("qarl",)))
    again = parse(dumps(run), "run.toml")
    assert again == run and 'strength = "drop:0.3"' in dumps(run) and "=7.5" in dumps(run)
    assert override(run, ["control.forces=qarl"], "--set").section("control").solved.endswith("qarl/drop:0.3=9.0")
    plain = override(run, ["control.strength=2"], "--set").section("control")
    assert (plain.strength, plain.solved) == (2.0, "")
    assert parse(RUN, "file").section("control").solved.endswith("=8.0")


def test_a_drop_in_meta_world_is_measured_in_meters(own):
    own(row(0.6, problem="metaworld-pick-place", forces=(), meters=0.01))
    text = 'problem = "metaworld-pick-place"\n[control]\nstrength = "drop:0.3"\ndisturbance = {}\n'
    small, large = (parse(text.format(meters), "file").section("control") for meters in ("0.01", "0.02"))
    assert calibrated_strength.strength(small, "metaworld-pick-place") == 0.6
    assert calibrated_strength.strength(large, "metaworld-pick-place") == pytest.approx(0.3)
    with pytest.raises(ConfigError, match=r"control\.disturbance = 0"):
        parse(text.format("0.0"), "file")


@pytest.mark.parametrize("given", ["bit:0.25", "drop:0", "drop:1", "drop:25%", "drop:-0.1", "drop:nan", "strong", "2"])
def test_a_strength_that_is_neither_a_number_nor_a_drop_is_refused_with_the_form(given):
    with pytest.raises(ConfigError, match=rf"file: control\.strength = '{given}': write a number, or drop:SHARE"):
        parse(RUN.replace("drop:0.3", given), "file")


def test_an_unsolved_drop_is_refused_with_the_command_that_solves_it(own, capsys):
    file = own(row(7.5, share=0.5))
    assert main.main(["train", f"{KIND}-laptop", "--control.strength", "drop:0.25", "--out", str(file.parent / "r")]) == 2
    printed = capsys.readouterr().err
    assert printed.count("\n") == 1 and f"`icrl-dist bench disturbance --problem {KIND} --drop 0.25`" in printed
    assert "solved: drop:0.5" in printed
    with pytest.raises(ConfigError, match=r"not solved for dmc-hopper-hop .*solved: none"):
        override(load("dmc-hopper-hop"), ["control.strength=drop:0.5"], "--set")
    with pytest.raises(ConfigError, match=r"section \[control\]: problem = 'darkroom' has no such section"):
        parse('[control]\nstrength = "drop:0.25"', "file")
    file.write_text("[{}]")
    with pytest.raises(ConfigError, match=r"not a table of calibrated strengths.*delete it"):
        parse(RUN, "file")
    file.write_text(file.read_text().replace("{}", '{"metres": 0.01}'))
    with pytest.raises(ConfigError, match=r"drops\.json: metres is now called meters: rename it$"):
        parse(RUN, "file")


def test_the_packaged_table_contains_the_measurements_of_each_strength():
    for one in calibrated_strength.packaged():
        assert one["problem"] in (*domains.PROBLEMS, "metaworld-pick-place") and one["reached"]
        assert one["lost_mean"] >= one["drop"] == calibrated_strength.share(f"drop:{one['drop']:g}")
        below = [share for strength, share in one["tried"] if strength < one["strength"]]
        assert below and max(below) < one["drop"], "no smaller strength that was tried reaches the drop"
        assert f"--problem {one['problem']} --drop" in one["command"] and one["versions"] and one["date"]
        assert one["undisturbed"] >= drop.COMPETENT * (5000 if one["meters"] else 200)


def test_a_solved_strength_is_stored_for_later_runs(own, monkeypatch, capsys):
    settings = [Setting("qarl", domains.task(KIND, forces="qarl", horizon=20), 2)]
    monkeypatch.setattr(disturbance, "settings", lambda kind: settings)
    monkeypatch.setattr(drop, "settings", lambda kind: settings)
    monkeypatch.setattr(drop, "_tasks", lambda kind, one, sizes: (one.task,))
    monkeypatch.setattr(drop, "_expert", lambda kind, config, report: Balances)
    monkeypatch.setattr(drop, "solve", functools.partial(drop.solve, first=0.5, most=8.0, tolerance=0.4))
    monkeypatch.setattr(drop, "SIZES", DisturbanceSizes(adversaries=1, episodes=1))
    assert main.main(["bench", "disturbance", "--problem", KIND, "--drop", "0.01", "--json"]) == 0
    out = capsys.readouterr().out
    (solved,) = json.loads(out.splitlines()[-1])["problems"]
    assert solved["lost_mean"] >= 0.01 and solved["reached"] and len(solved["tried"]) > 1
    kept = calibrated_strength.own()
    assert kept == [solved]
    slow = disturbance.adversaries(settings[0], 1, solved["strength"])
    measured = disturbance.measure([Variation(settings[0].task, push) for push in slow], Balances, 1, 1)
    assert disturbance.lost(measured.returns)["lost_mean"] == pytest.approx(solved["lost_mean"])
    drop._store(solved)
    assert calibrated_strength.own() == kept, "it replaces its own row"


def test_no_drop_is_measured_with_an_incompetent_expert(own, monkeypatch):
    class Idle(Balances):
        def act(self, observation, u):
            return np.full((len(observation), 1), np.float32(1))

    settings = Setting("qarl", domains.task(KIND, forces="qarl", horizon=20), 2)
    monkeypatch.setattr(drop, "_tasks", lambda kind, one, sizes: (one.task,))
    monkeypatch.setattr(drop, "settings", lambda kind: [settings])
    monkeypatch.setattr(drop, "_expert", lambda kind, config, report: Idle)
    with pytest.raises(ConfigError, match=r"have a return of .* undisturbed, below 19: train longer"):
        monkeypatch.setattr(drop, "COMPETENT", 0.95)
        drop.run(0.25, KIND, sizes=DisturbanceSizes(adversaries=1, episodes=1))
    assert not calibrated_strength.own_file().exists()
    with pytest.raises(ConfigError, match="did you mean 'dmc-hopper-hop'"):
        drop.run(0.25, "dmc-hoper-hop")
