"""What the default disturbances cost: against a slow loop, on equal terms, and said when it is next to nothing."""

import dataclasses
import json
import statistics

import numpy as np
import pytest
import torch

from icrl_dist.bench import disturbance
from icrl_dist.bench.disturbance import Setting, Sizes, ToldTheGoal
from icrl_dist.cli import main
from icrl_dist.config.run import ConfigError
from icrl_dist.config.sac import SACConfig
from icrl_dist.experts.sac import batched
from icrl_dist.problems import registry
from icrl_dist.problems.continuous import network_adversary
from icrl_dist.problems.continuous.network_adversary import Networks
from icrl_dist.problems.dmc import domains, simulation
from icrl_dist.problems.metaworld import environment, pick_place
from icrl_dist.types import NULL, Variation

KIND = "dmc-cartpole-balance"
SIZES = Sizes(adversaries=3, episodes=2)


class Balances:
    """A hand-made controller of the pole; remembers what it saw."""

    def __init__(self, env):
        self.seen = []

    def act(self, observation, u):
        self.seen.append(observation)
        place, _, sine, speed, spin = observation.T
        return np.clip(0.6 * place + 8 * sine + 0.8 * speed + 1.5 * spin, -1, 1)[:, None].astype(np.float32)

    def observe(self, *transition):
        pass


def short(horizon=25, forces="qarl"):
    return Setting(forces, domains.task(KIND, forces=forces, horizon=horizon), 2)


def slow_return(task, adversary, episode):
    """One episode of one simulation, step by step."""
    game, total = simulation.DMC([task]), 0.0
    pushing = Networks([adversary], game.spec, game.disturbance)
    seen = game.reset([disturbance._chance(episode, 0)])
    policy = Balances(None)
    for _ in range(game.spec.horizon):
        step = game.step(policy.act(seen, None), pushing.act(seen))
        seen, total = step.observation, total + float(step.reward[0])
    return total


def test_what_is_lost_is_what_a_slow_loop_over_single_simulations_says():
    one = short()
    rows, tasks = disturbance.variations(one, SIZES)
    assert tasks == 1 and rows[0] == Variation(one.task, NULL) and len({row.adversary for row in rows}) == 4
    measured = disturbance.measure(rows, Balances, SIZES.episodes, tasks)
    expected = [[slow_return(one.task, row.adversary, episode) for row in rows] for episode in range(2)]
    np.testing.assert_allclose(measured.returns, expected, rtol=1e-5)
    found = disturbance.lost(measured.returns)
    alone = statistics.mean(row[0] for row in expected)
    shares = [1 - statistics.mean(row[k] for row in expected) / alone for k in (1, 2, 3)]
    gaps = [row[0] - statistics.mean(row[1:]) for row in expected]
    assert found["undisturbed"] == pytest.approx(alone, rel=1e-5)
    assert found["lost_mean"] == pytest.approx(statistics.mean(shares), abs=1e-5)
    assert found["lost_worst"] == pytest.approx(max(shares), abs=1e-5) and max(shares) > 0.01
    assert found["lost_error"] == pytest.approx(statistics.stdev(gaps) / 2**0.5 / alone, abs=1e-5)
    assert found["worst"] <= found["mean"] < found["undisturbed"] and measured.broken == 0


def test_episodes_begin_alike_under_every_adversary_and_each_otherwise_than_the_last():
    one, kept = short(horizon=3), []
    rows, tasks = disturbance.variations(one, SIZES)
    disturbance.measure(rows, lambda env: kept.append(Balances(env)) or kept[0], 2, tasks)
    first, second = kept[0].seen[0], kept[0].seen[3]
    for begun in (first, second):
        np.testing.assert_array_equal(begun, np.broadcast_to(begun[:1], begun.shape))
    assert np.abs(first - second).max() > 1e-4


def test_a_default_disturbance_that_takes_next_to_nothing_is_called_weak_and_a_strong_one_is_not(monkeypatch, capsys):
    monkeypatch.setattr(disturbance, "policy", lambda kind, config, report: Balances)
    monkeypatch.setattr(disturbance, "QUICK", Sizes(adversaries=3, episodes=1))
    assert main.main(["bench", "disturbance", "--problem", KIND, "--quick", "--json"]) == 0
    out, err = capsys.readouterr()
    result = json.loads(out.splitlines()[-1])
    paper, qarl = result["problems"]
    assert (paper["forces"], paper["newtons"], qarl["forces"], qarl["newtons"]) == ("paper", 0.005, "qarl", 2.0)
    assert paper["undisturbed"] == qarl["undisturbed"] > 190, "the same expert, the same episodes"
    assert paper["weak"] and abs(paper["lost_mean"]) < 0.02 and "under 2%" in paper["said"]
    assert not qarl["weak"] and qarl["lost_mean"] > 0.02 and qarl["said"] == ""
    assert (result["weak"], result["adversaries"]) == (1, 3)
    assert "weak: on average the default adversaries take" in err.split("returns of experts")[1]


@pytest.mark.parametrize(
    ("undisturbed", "lost_mean", "weak", "untaught"),
    [
        (100.0, 0.0199, True, False),
        (100.0, -0.3, True, False),
        (100.0, 0.02, False, False),
        (1.9, 0.001, False, True),
        (0.0, None, False, True),
    ],
)
def test_of_an_expert_that_earns_nothing_nothing_is_said_to_be_lost(undisturbed, lost_mean, weak, untaught):
    found = disturbance.verdict({"undisturbed": undisturbed, "lost_mean": lost_mean, "lost_error": 0.001}, 200)
    assert (found["weak"], found["untaught"], bool(found["said"])) == (weak, untaught, weak or untaught)


def test_weak_within_an_error_that_leaves_it_open_says_that_too():
    said = [
        disturbance.verdict({"undisturbed": 100.0, "lost_mean": 0.01, "lost_error": error}, 200)["said"]
        for error in (0.004, 0.005, None)
    ]
    assert all(one.startswith("weak") for one in said) and ["too few" in one for one in said] == [False, True, True]


def test_without_any_return_shares_are_none_and_the_table_has_them():
    found = disturbance.lost(np.zeros((1, 3)))
    assert (found["lost_mean"], found["lost_worst"], found["lost_error"], found["mean_error"]) == (None,) * 4
    row = {"problem": "dmc-hopper-hop", "forces": "paper", **found, **disturbance.verdict(found, 200)}
    assert "nothing to lose" in disturbance.describe({"adversaries": 2, "problems": [row]})


def test_an_expert_is_trained_once_undisturbed_and_met_by_every_preset(monkeypatch, tmp_path):
    trained, real = [], batched.train
    monkeypatch.setattr(batched, "train", lambda env, *rest, **more: trained.append(env.batch) or real(env, *rest, **more))
    tiny = SACConfig(hidden=(8, 8), batch=8, random_steps=190, warmup=195, steps=200, cache=str(tmp_path))
    monkeypatch.setattr(disturbance, "settings", lambda kind: [short(5, "paper"), short(5, "qarl")])
    monkeypatch.setattr(disturbance, "numbers", lambda kind, steps: tiny)
    said, threads = [], torch.get_num_threads()
    first = disturbance.run(KIND, report=said.append, sizes=SIZES)
    assert trained == [1] and any("trains for 200 steps" in line for line in said)
    said.clear()
    assert disturbance.run(KIND, report=said.append, sizes=SIZES) == first
    assert trained == [1] and not any("trains" in line for line in said)
    assert torch.get_num_threads() == threads
    monkeypatch.setattr(disturbance, "numbers", lambda kind, steps: dataclasses.replace(tiny, cache=""))
    with pytest.raises(ConfigError, match=r"sac\.cache = ''"):
        disturbance.run(KIND, sizes=SIZES)


def test_the_scripted_policy_acts_by_what_it_is_shown_and_by_the_true_goal():
    task = pick_place.task((0.02, 0.65, 0.02), (0.05, 0.85, 0.2), horizon=3)
    env = environment.PickPlace([Variation(task), Variation(task, network_adversary.network(1, 39, 9))])
    policy = ToldTheGoal(env)
    shown = env.reset([np.random.default_rng(0)] * 2)
    acted, truly = policy.act(shown, np.zeros((2, 4))), environment.expert(env.truth)
    np.testing.assert_allclose(acted[0], truly[0], atol=1e-4)
    assert np.abs(acted[1] - truly[1]).max() > 0.02, "the disturbance reaches it"
    expected = np.concatenate([shown[1, :36], [0.05, 0.85, 0.2]])[None]
    np.testing.assert_array_equal(acted[1], environment.expert(expected.astype(np.float64))[0])


def test_in_meta_world_every_task_meets_every_adversary_at_1_cm(monkeypatch):
    (one,) = disturbance.settings(pick_place.KIND)
    rows, tasks = disturbance.variations(one, Sizes(adversaries=2, tasks=2))
    assert (tasks, len(rows)) == (2, 6) and len({row.task for row in rows[:3]}) == 1 == len({row.task for row in rows[3:]})
    assert rows[0].task != rows[3].task and [row.adversary for row in rows[:3]] == [row.adversary for row in rows[3:]]
    assert pick_place.disturbance(rows[1].task) == 0.01 and rows[1].adversary["strength"] == 1.0
    brief = [dataclasses.replace(row, task=row.task.replace(horizon=4)) for row in rows]
    measured = disturbance.measure(brief, ToldTheGoal, 1, tasks)
    assert measured.returns.shape == (2, 3) and measured.succeeded.tolist() == [0, 0, 0]
    assert (np.abs(measured.returns[:, 1:] - measured.returns[:, :1]) > 1e-6).all()


@pytest.mark.parametrize("kind", domains.PROBLEMS)
def test_both_presets_are_measured_where_they_differ(kind):
    presets = [one.forces for one in disturbance.settings(kind)]
    assert presets == (["paper", "qarl"] if kind.split("-")[1] in ("cartpole", "hopper", "quadruped") else ["paper"])
    for one in disturbance.settings(kind):
        env = registry.batch(
            [Variation(one.task, network_adversary.network(0, registry.spec(one.task).observation, one.outputs))]
        )
        assert env.batch == 1
    assert disturbance.numbers(kind).steps == disturbance.LONGER.get(kind, 12_000)
    assert disturbance.numbers(kind, 500).steps == 500 and disturbance.numbers(kind).hidden == (64, 64)


def test_what_it_cannot_measure_is_refused_with_the_nearest_name(capsys):
    assert main.main(["bench", "disturbance", "--problem", "dmc-walker-rum"]) == 2
    assert "did you mean 'dmc-walker-run'" in capsys.readouterr().err
    assert main.main(["bench", "disturbance", "--problem", "darkroom"]) == 2
    assert main.main(["bench", "disturbance", "--seconds", "3"]) == 2
    assert "this benchmark has a fixed size" in capsys.readouterr().err
