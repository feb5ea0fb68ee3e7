"""The disturbance benchmark: losses against a slow loop, paired episodes, and the verdict on weak disturbances."""

import dataclasses
import json
import statistics

import numpy as np
import pytest
import torch

from icrl_dist.bench import disturbance
from icrl_dist.bench.disturbance import DisturbanceSizes
from icrl_dist.cli import main
from icrl_dist.config.run import ConfigError
from icrl_dist.config.sac import SACConfig
from icrl_dist.experts.sac import batched
from icrl_dist.problems import registry
from icrl_dist.problems.continuous import network_adversary
from icrl_dist.problems.continuous.disturbance import Setting
from icrl_dist.problems.continuous.network_adversary import Networks
from icrl_dist.problems.dmc import domains, simulation
from icrl_dist.problems.dmc.bench import LONGER
from icrl_dist.problems.metaworld import environment, pick_place
from icrl_dist.problems.metaworld.bench import ScriptedWithGoal
from icrl_dist.types import NULL, Variation
from tests.calls import keeping, noting
from tests.optional import known

KIND = "dmc-cartpole-balance"
SIZES = DisturbanceSizes(adversaries=3, episodes=2)


class Balances:
    """A hand-written controller of the pole that records its observations."""

    def __init__(self, env):
        self.observations = []

    def act(self, observation, u):
        self.observations.append(observation)
        position, _, sine, velocity, angular = observation.T
        return np.clip(0.6 * position + 8 * sine + 0.8 * velocity + 1.5 * angular, -1, 1)[:, None].astype(np.float32)

    def observe(self, *transition):
        pass


def short(horizon=25, forces="qarl"):
    return Setting(forces, domains.task(KIND, forces=forces, horizon=horizon), 2)


def slow_return(task, adversary, episode):
    """One episode of one simulation, step by step."""
    env, total = simulation.DMC([task]), 0.0
    networks = Networks([adversary], env.spec, env.disturbance)
    observation = env.reset([disturbance._episode_rng(episode, 0)])
    policy = Balances(None)
    for _ in range(env.spec.horizon):
        step = env.step(policy.act(observation, None), networks.act(observation))
        observation, total = step.observation, total + float(step.reward[0])
    return total


def test_losses_equal_those_of_a_slow_loop_over_single_simulations():
    setting = short()
    rows, tasks = disturbance.variations(setting, SIZES)
    assert tasks == 1 and rows[0] == Variation(setting.task, NULL) and len({row.adversary for row in rows}) == 4
    measured = disturbance.measure(rows, Balances, SIZES.episodes, tasks)
    expected = [[slow_return(setting.task, row.adversary, episode) for row in rows] for episode in range(2)]
    np.testing.assert_allclose(measured.returns, expected, rtol=1e-5)
    found = disturbance.lost(measured.returns)
    undisturbed = statistics.mean(row[0] for row in expected)
    shares = [1 - statistics.mean(row[k] for row in expected) / undisturbed for k in (1, 2, 3)]
    gaps = [row[0] - statistics.mean(row[1:]) for row in expected]
    assert found["undisturbed"] == pytest.approx(undisturbed, rel=1e-5)
    assert found["lost_mean"] == pytest.approx(statistics.mean(shares), abs=1e-5)
    assert found["lost_worst"] == pytest.approx(max(shares), abs=1e-5) and max(shares) > 0.01
    assert found["lost_error"] == pytest.approx(statistics.stdev(gaps) / 2**0.5 / undisturbed, abs=1e-5)
    assert known(found["worst"]) <= known(found["mean"]) < known(found["undisturbed"]) and measured.broken == 0


def test_initial_states_are_equal_under_all_adversaries_and_differ_between_episodes():
    setting, policies = short(horizon=3), list[Balances]()
    rows, tasks = disturbance.variations(setting, SIZES)
    disturbance.measure(rows, keeping(policies, Balances), 2, tasks)
    first, second = policies[0].observations[0], policies[0].observations[3]
    for initial in (first, second):
        np.testing.assert_array_equal(initial, np.broadcast_to(initial[:1], initial.shape))
    assert np.abs(first - second).max() > 1e-4


def test_a_default_disturbance_without_loss_is_weak_and_a_strong_one_is_not(monkeypatch, capsys):
    monkeypatch.setattr(disturbance, "policy", lambda kind, config, report: Balances)
    monkeypatch.setattr(disturbance, "QUICK", DisturbanceSizes(adversaries=3, episodes=1))
    assert main.main(["bench", "disturbance", "--problem", KIND, "--quick", "--json"]) == 0
    out, err = capsys.readouterr()
    result = json.loads(out.splitlines()[-1])
    paper, qarl = result["problems"]
    assert (paper["forces"], paper["newtons"], qarl["forces"], qarl["newtons"]) == ("paper", 0.005, "qarl", 2.0)
    assert paper["undisturbed"] == qarl["undisturbed"] > 190, "the presets must share the expert and the episodes"
    assert paper["weak"] and abs(paper["lost_mean"]) < 0.02 and "less than 2%" in paper["note"]
    assert not qarl["weak"] and qarl["lost_mean"] > 0.02 and qarl["note"] == ""
    assert (result["weak"], result["adversaries"]) == (1, 3)
    assert "weak: the default adversaries reduce the return by" in err.split("returns of experts")[1]


@pytest.mark.parametrize(
    ("undisturbed", "lost_mean", "weak", "low_return"),
    [
        (100.0, 0.0199, True, False),
        (100.0, -0.3, True, False),
        (100.0, 0.02, False, False),
        (1.9, 0.001, False, True),
        (0.0, None, False, True),
    ],
)
def test_no_loss_is_reported_for_an_expert_with_too_small_a_return(undisturbed, lost_mean, weak, low_return):
    found = disturbance.verdict({"undisturbed": undisturbed, "lost_mean": lost_mean, "lost_error": 0.001}, 200)
    assert (found["weak"], found["low_return"], bool(found["note"])) == (weak, low_return, weak or low_return)


def test_a_weak_verdict_within_the_standard_error_says_so():
    sentences = [
        disturbance.verdict({"undisturbed": 100.0, "lost_mean": 0.01, "lost_error": error}, 200)["note"]
        for error in (0.004, 0.005, None)
    ]
    assert all(text.startswith("weak") for text in sentences)
    assert ["may be larger" in text for text in sentences] == [False, True, True]


def test_without_any_return_losses_are_none_and_the_table_has_a_row():
    found = disturbance.lost(np.zeros((1, 3)))
    assert (found["lost_mean"], found["lost_worst"], found["lost_error"], found["mean_error"]) == (None,) * 4
    row = {"problem": "dmc-hopper-hop", "forces": "paper", **found, **disturbance.verdict(found, 200)}
    assert "too small to measure a loss" in disturbance.describe({"adversaries": 2, "problems": [row]})


def test_an_expert_is_trained_once_without_disturbance_and_used_for_every_preset(monkeypatch, tmp_path):
    trained = list[int]()
    monkeypatch.setattr(batched, "train", noting(trained, lambda env, *rest, **more: env.batch, batched.train))
    tiny = SACConfig(hidden=(8, 8), batch=8, random_steps=190, warmup=195, steps=200, cache=str(tmp_path))
    monkeypatch.setattr(disturbance, "settings", lambda kind: [short(5, "paper"), short(5, "qarl")])
    monkeypatch.setattr(disturbance, "sac_config", lambda kind, steps: tiny)
    messages, threads = list[str](), torch.get_num_threads()
    first = disturbance.run(KIND, report=messages.append, sizes=SIZES)
    assert trained == [1] and any("for 200 steps" in line for line in messages)
    messages.clear()
    assert disturbance.run(KIND, report=messages.append, sizes=SIZES) == first
    assert trained == [1] and not any("training" in line for line in messages)
    assert torch.get_num_threads() == threads
    monkeypatch.setattr(disturbance, "sac_config", lambda kind, steps: dataclasses.replace(tiny, cache=""))
    with pytest.raises(ConfigError, match=r"sac\.cache = ''"):
        disturbance.run(KIND, sizes=SIZES)


def test_the_scripted_policy_uses_the_observed_state_and_the_true_goal():
    task = pick_place.task((0.02, 0.65, 0.02), (0.05, 0.85, 0.2), horizon=3)
    env = environment.PickPlace([Variation(task), Variation(task, network_adversary.network(1, 39, 9))])
    policy = ScriptedWithGoal(env)
    observed = env.reset([np.random.default_rng(0)] * 2)
    actions, true_actions = policy.act(observed, np.zeros((2, 4))), environment.expert(env.truth)
    np.testing.assert_allclose(actions[0], true_actions[0], atol=1e-4)
    assert np.abs(actions[1] - true_actions[1]).max() > 0.02, "the disturbance must change its actions"
    expected = np.concatenate([observed[1, :36], [0.05, 0.85, 0.2]])[None]
    np.testing.assert_array_equal(actions[1], environment.expert(expected.astype(np.float64))[0])


def test_in_meta_world_every_task_has_every_adversary_at_1_cm(monkeypatch):
    (setting,) = disturbance.settings(pick_place.KIND)
    rows, tasks = disturbance.variations(setting, DisturbanceSizes(adversaries=2, tasks=2))
    assert (tasks, len(rows)) == (2, 6) and len({row.task for row in rows[:3]}) == 1 == len({row.task for row in rows[3:]})
    assert rows[0].task != rows[3].task and [row.adversary for row in rows[:3]] == [row.adversary for row in rows[3:]]
    assert pick_place.disturbance(rows[1].task) == 0.01 and rows[1].adversary["strength"] == 1.0
    short_rows = [dataclasses.replace(row, task=row.task.replace(horizon=4)) for row in rows]
    measured = disturbance.measure(short_rows, ScriptedWithGoal, 1, tasks)
    assert measured.returns.shape == (2, 3) and known(measured.succeeded).tolist() == [0, 0, 0]
    assert (np.abs(measured.returns[:, 1:] - measured.returns[:, :1]) > 1e-6).all()


@pytest.mark.parametrize("kind", domains.PROBLEMS)
def test_both_presets_are_measured_if_they_differ(kind):
    presets = [setting.forces for setting in disturbance.settings(kind)]
    assert presets == (["paper", "qarl"] if kind.split("-")[1] in ("cartpole", "hopper", "quadruped") else ["paper"])
    for setting in disturbance.settings(kind):
        env = registry.batch(
            [Variation(setting.task, network_adversary.network(0, registry.spec(setting.task).observation, setting.outputs))]
        )
        assert env.batch == 1
    assert disturbance.sac_config(kind).steps == LONGER.get(kind, 12_000)
    assert disturbance.sac_config(kind, 500).steps == 500 and disturbance.sac_config(kind).hidden == (64, 64)


def test_invalid_arguments_are_refused_with_the_nearest_name(capsys):
    assert main.main(["bench", "disturbance", "--problem", "dmc-walker-rum"]) == 2
    assert "did you mean 'dmc-walker-run'" in capsys.readouterr().err
    assert main.main(["bench", "disturbance", "--problem", "darkroom"]) == 2
    assert main.main(["bench", "disturbance", "--seconds", "3"]) == 2
    assert "this benchmark has a fixed size" in capsys.readouterr().err
