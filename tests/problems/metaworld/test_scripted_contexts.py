"""Contexts of Meta-World's scripted policy: who is told what, what disturbs it, and whose labels they carry."""

import dataclasses

import numpy as np
import pytest
from icrl_dist.methods.recipes import METHODS

from icrl_dist.collect import jobs
from icrl_dist.config.run import ConfigError, load, override
from icrl_dist.config.sections import AdversaryConfig
from icrl_dist.experts import delivery
from icrl_dist.problems import registry
from icrl_dist.problems.continuous.config import ControlConfig
from icrl_dist.problems.metaworld import environment, pick_place, scripted_contexts
from icrl_dist.problems.metaworld.scripted_contexts import EpisodePlan
from icrl_dist.stream import wire
from icrl_dist.training.batches import Examples
from tests.methods.test_recipes import Kept

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
    return dataclasses.replace(
        small_run, problem="metaworld-pick-place", control=control, adversary=AdversaryConfig(count=2), pretrain=pretrain
    )


def asked(run):
    (job,) = METHODS["icag"].ask(run, METHODS["icag"].phases(run)[0])
    return job


def test_half_of_the_episodes_are_told_the_goal_and_the_rest_places_where_goals_lie(spec):
    goal = np.array([0.05, 0.85, 0.2])
    rngs = [np.random.default_rng(seed) for seed in range(200)]
    right = [EpisodePlan.drawn(rng, goal, True, spec) for rng in rngs]
    wrong = [EpisodePlan.drawn(rng, goal, False, spec) for rng in rngs]
    assert all((one.goals == goal).all() for one in right)
    told = np.stack([one.goals for one in wrong])
    low, high = pick_place.GOALS
    assert (told >= low).all() and (told <= high).all() and np.abs(told - goal).sum(-1).min() > 1e-3
    changes = (np.diff(told, axis=1) != 0).any(axis=2).sum(axis=1)
    assert set(changes.tolist()) == {0, 1} and told.std(axis=(0, 1)).min() > 0.02
    deviations = np.array([one.noise.std() for one in right])
    assert 0 <= deviations.min() < 0.1 and 0.5 < deviations.max() < 1.1 * scripted_contexts.NOISE
    lapses = np.stack([one.lapses for one in right])
    assert 0.05 < lapses.mean() < 0.2 and (~lapses.any(axis=1)).any()
    assert all((np.abs(one.lapse_actions[one.lapses]).max(axis=1) > 0).all() for one in right if one.lapses.any())


def test_actions_are_the_leaders_with_its_noise_and_labels_the_true_goals(run, monkeypatch):
    monkeypatch.setattr(scripted_contexts, "LAPSE_PROBABILITY", 0.2)
    job, told = asked(run), []
    assert job.kind == "scripted_context" and wire.decode_job(wire.encode_job(job)) == job
    drawn = EpisodePlan.drawn.__func__
    keep = lambda cls, *given: told.append(drawn(cls, *given)) or told[-1]  # noqa: E731
    monkeypatch.setattr(EpisodePlan, "drawn", classmethod(keep))
    sent = list(jobs.do(job, None, "w"))
    assert [t.identity for t in sent] == list(job.identities()) and {t.origin for t in sent} == {"expert"}
    states = {}
    for trial in range(TRIALS):
        env = registry.batch(job.variations)  # once more, one step after the other, from the actions that were sent
        seen = env.reset([np.random.default_rng(0)] * 4)
        rows = [next(t for t in sent if t.variation == v and t.identity.trial == trial) for v in job.variations]
        leads = told[4 * trial : 4 * trial + 4]
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
    assert any(lead.lapses[:HORIZON].any() for lead in told)
    for t in sent:
        assert not t.observations[:, 36:].any() and len(t.queries) == HORIZON and not len(t.taken)
        labels = np.stack([states[query.tobytes(), t.variation] for query in t.queries])
        np.testing.assert_allclose(t.labels, labels, atol=1e-3)
    (pool,) = METHODS["icag"].learn(run, METHODS["icag"].phases(run)[0], Kept(sent))
    assert isinstance(pool.examples[0], Examples) and len(pool.examples) == 4


def test_the_same_job_gives_the_same_bytes_and_stretches_when_they_are_asked_for(run, monkeypatch):
    monkeypatch.setattr(delivery, "LED", 1)
    model = dataclasses.replace(run.model, window=4)
    run = dataclasses.replace(run, model=model, pretrain=dataclasses.replace(run.pretrain, windows=3, contexts=4))
    job = dataclasses.replace(asked(run), tasks=1, variations=asked(run).variations[:2])
    sent, again = (list(jobs.do(job, None, "w")) for _ in range(2))
    assert [wire.trajectory_digest(t) for t in sent] == [wire.trajectory_digest(t) for t in again]
    for t in sent:
        assert t.taken.shape == (12, 4) and len(t.queries) == HORIZON + 12


def test_who_has_no_scripted_policy_is_told_so():
    with pytest.raises(ConfigError, match=r"control\.histories = 'scripted': only Meta-World"):
        override(load("dmc-reacher-easy"), ["control.histories=scripted"], "--set")
    with pytest.raises(ConfigError, match=r"control\.histories = 'scripted': use sac: the method experts"):
        override(load("experts-metaworld-laptop"), [], "--set")
    assert load("metaworld").control.histories == "sac", "the paper's"
