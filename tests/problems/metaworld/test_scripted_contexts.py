"""Contexts of Meta-World's scripted policy: the goals it is given, its noise, and the labels."""

import dataclasses

import numpy as np
import pytest

from icrl_dist.config.run import ConfigError, load, override
from icrl_dist.config.sections import AdversaryConfig
from icrl_dist.experts import trajectories
from icrl_dist.methods import registry as methods
from icrl_dist.problems import registry
from icrl_dist.problems.continuous.config import ControlConfig
from icrl_dist.problems.metaworld import environment, pick_place, scripted_contexts
from icrl_dist.problems.metaworld.scripted_contexts import EpisodePlan
from icrl_dist.stream import wire
from icrl_dist.training.batches import TrainingBatch
from tests.calls import keeping
from tests.jobs import InMemoryDataset, decoded, do, in_problem, jobs_of

HORIZON, TRIALS = 10, 2


@pytest.fixture(scope="module")
def spec():
    return registry.spec(pick_place.task((0.0, 0.65, 0.02), (0.0, 0.85, 0.2), horizon=200))


@pytest.fixture
def run(small_run, monkeypatch):
    chosen = tuple(pick_place.task((x, 0.65, 0.02), (-x, 0.85, 0.2)) for x in (-0.05, 0.0, 0.05))
    monkeypatch.setattr(environment, "ml1_tasks", lambda count, seed: chosen[:count])  # theirs take seconds to make
    control = ControlConfig(train_tasks=2, test_tasks=1, horizon=HORIZON, histories="scripted")
    pretrain = dataclasses.replace(small_run.pretrain, contexts=4 * TRIALS, queries=HORIZON)
    more = {"method": "icag", "control": control, "adversary": AdversaryConfig(count=1), "pretrain": pretrain}
    return in_problem(small_run, "metaworld-pick-place", **more)


def job_of(run):
    (job,) = jobs_of(run)
    return job


def test_half_of_the_episodes_lead_to_the_goal_and_the_rest_to_other_places_in_its_box(spec):
    goal = np.array([0.05, 0.85, 0.2])
    rngs = [np.random.default_rng(seed) for seed in range(200)]
    right = [EpisodePlan.drawn(rng, goal, True, spec) for rng in rngs]
    wrong = [EpisodePlan.drawn(rng, goal, False, spec) for rng in rngs]
    assert all((one.goals == goal).all() for one in right)
    given = np.stack([one.goals for one in wrong])
    low, high = pick_place.GOALS
    assert (given >= low).all() and (given <= high).all() and np.abs(given - goal).sum(-1).min() > 1e-3
    changes = (np.diff(given, axis=1) != 0).any(axis=2).sum(axis=1)
    assert set(changes.tolist()) == {0, 1} and given.std(axis=(0, 1)).min() > 0.02
    deviations = np.array([one.noise.std() for one in right])
    assert 0 <= deviations.min() < 0.1 and 0.5 < deviations.max() < 1.1 * scripted_contexts.NOISE
    lapses = np.stack([one.lapses for one in right])
    assert 0.05 < lapses.mean() < 0.2 and (~lapses.any(axis=1)).any()
    assert all((np.abs(one.lapse_actions[one.lapses]).max(axis=1) > 0).all() for one in right if one.lapses.any())


def test_actions_are_the_scripted_ones_with_noise_and_labels_those_of_the_true_goal(run, monkeypatch):
    monkeypatch.setattr(scripted_contexts, "LAPSE_PROBABILITY", 0.2)
    job, given = job_of(run), list[EpisodePlan]()
    assert job.kind == "scripted_context" and decoded(run, wire.encode_job(job)) == job
    monkeypatch.setattr(EpisodePlan, "drawn", staticmethod(keeping(given, EpisodePlan.drawn)))
    sent = do(run, job)
    assert [t.identity for t in sent] == list(job.identities()) and {t.origin for t in sent} == {"expert"}
    states = {}
    for trial in range(TRIALS):
        env = registry.batch(job.variations)  # once more, one step after the other, from the actions that were sent
        assert isinstance(env, environment.PickPlace)
        seen = env.reset([np.random.default_rng(0)] * 4)
        rows = [next(t for t in sent if t.variation == v and t.identity.trial == trial) for v in job.variations]
        leads = given[4 * trial : 4 * trial + 4]
        for step in range(HORIZON):
            for row, (one, lead) in enumerate(zip(rows, leads, strict=True)):
                truth = env.truth[row].copy()
                states[seen[row].tobytes(), one.variation] = environment.expert(truth[None])[0]
                truth[36:] = lead.goals[step]
                wanted = np.clip(environment.expert(truth[None])[0] + lead.noise[step], -1, 1)
                wanted = lead.lapse_actions[step] if lead.lapses[step] else wanted
                np.testing.assert_allclose(one.actions[step], wanted, atol=1e-6)
            seen = env.step(np.stack([one.actions[step] for one in rows])).observation
        assert all(np.allclose(one.observations[-1], seen[row]) for row, one in enumerate(rows))
    assert any(plan.lapses[:HORIZON].any() for plan in given)
    for t in sent:
        assert not t.observations[:, 36:].any() and len(t.queries) == HORIZON and not len(t.prev_actions)
        labels = np.stack([states[query.tobytes(), t.variation] for query in t.queries])
        np.testing.assert_allclose(t.labels, labels, atol=1e-3)
    method, data = methods.of(run), InMemoryDataset(sent)
    batch = method.data(run, method.phases(run)[0], data)(np.random.default_rng(0))
    assert len(data.variations("pretrain", 0)) == 4 and isinstance(batch, TrainingBatch)
    known = {tuple(label) for t in sent for label in t.labels}
    assert {tuple(label) for label in batch.labels.reshape(-1, 4)} <= known


def test_the_same_job_gives_the_same_bytes_with_action_windows(run, monkeypatch):
    monkeypatch.setattr(trajectories, "WINDOW_EPISODES", 1)
    model = dataclasses.replace(run.model, window=4)
    run = dataclasses.replace(run, model=model, pretrain=dataclasses.replace(run.pretrain, windows=3, contexts=4))
    job = dataclasses.replace(job_of(run), tasks=1, variations=job_of(run).variations[:2])
    sent, again = (do(run, job) for _ in range(2))
    assert [wire.trajectory_digest(t) for t in sent] == [wire.trajectory_digest(t) for t in again]
    for t in sent:
        assert t.prev_actions.shape == (12, 4) and len(t.queries) == HORIZON + 12


def test_scripted_histories_are_refused_where_there_is_no_scripted_policy():
    with pytest.raises(ConfigError, match=r"control\.histories = 'scripted': only Meta-World"):
        override(load("dmc-reacher-easy"), ["control.histories=scripted"], "--set")
    with pytest.raises(ConfigError, match=r"control\.histories = 'scripted': use sac: the method experts"):
        override(load("experts-metaworld-laptop"), [], "--set")
    assert load("metaworld").section("control").histories == "sac", "the paper's"
