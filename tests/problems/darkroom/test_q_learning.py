"""Histories of tabular Q-learning, against one table that is updated number by number."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from icrl_dist.config.q_learning import QLearning
from icrl_dist.config.run import Run, override
from icrl_dist.problems.darkroom.q_learning import QLearner, QLearningHistories
from icrl_dist.problems.darkroom.solver import Hypotheses, optimal_returns
from icrl_dist.stream import wire
from icrl_dist.types import Job, Trajectory, Variation
from tests.jobs import decoded, do, jobs_of

RATES = QLearning(epsilon=0.4, epsilon_end=0.1, step=0.9, step_end=0.3, discount=0.8, optimism=0.7)


@pytest.fixture
def ad_run(small_run: Run) -> Run:
    """Q-learning in a 5x5 room, 20 goals, 120 episodes each, in two histories."""
    settings = ["darkroom.size=5", "darkroom.horizon=20", "pretrain.contexts=2400", "ad.history_episodes=60"]
    return override(dataclasses.replace(small_run, method="ad"), settings, "--set")


def variation(job: Job, made: list[Trajectory], row: int) -> list[Trajectory]:
    """The trials of one row of a job, in order."""
    place = job.rows()[row]
    found = [t for t in made if (t.identity.task, t.identity.variation) == place]
    return sorted(found, key=lambda t: t.identity.trial)


def cell(observation: np.ndarray, size: int) -> int:
    return int(observation[0]) * size + int(observation[1])


def test_every_action_follows_from_the_table_of_a_scalar_loop(ad_run: Run) -> None:
    """With a restart: the probabilities, the draws and the updates of histories of three and four episodes."""
    job = dataclasses.replace(jobs_of(ad_run)[0], trials=7, payload=QLearningHistories(RATES, 2))
    made = do(ad_run, job)
    assert len(made) == 7 * len(job.variations)
    for row in range(len(job.variations)):
        for n, t in enumerate(variation(job, made, row)):
            progress = n / 2 if n < 3 else (n - 3) / 3
            epsilon, step = 0.4 - 0.3 * progress, 0.9 - 0.6 * progress
            if n in (0, 3):
                table = [[0.7] * 5 for _ in range(25)]
            rng = t.identity.rng(job.seed)
            rng.random(1 + 20)  # the environment's
            for h, u in enumerate(rng.random((20, 1))[:, 0]):
                here, after = cell(t.observations[h], 5), cell(t.observations[h + 1], 5)
                best = [a for a in range(5) if table[here][a] == max(table[here])]
                chosen, total = 4, 0.0
                for a in range(4):
                    total += epsilon / 5 + (1 - epsilon) * (a in best) / len(best)
                    if u < total:
                        chosen = a
                        break
                assert t.actions[h] == chosen, (row, n, h)
                target = float(t.rewards[h]) + 0.8 * max(table[after])
                table[here][chosen] += step * (target - table[here][chosen])


def test_the_learner_of_one_room_does_not_depend_on_the_others(ad_run: Run) -> None:
    job = jobs_of(ad_run)[0]
    job = dataclasses.replace(job, trials=8)
    alone = dataclasses.replace(job, tasks=1, variations=job.variations[:1])
    together = variation(job, do(ad_run, job), 0)
    assert [wire.trajectory_digest(t) for t in do(ad_run, alone)] == [wire.trajectory_digest(t) for t in together]


def test_a_job_repeats_itself_also_after_the_way_to_another_worker(ad_run: Run) -> None:
    """Its episodes depend on its seed alone, and have no labels."""
    job = jobs_of(ad_run)[1]
    again = decoded(ad_run, wire.encode_job(job))
    assert again == job and isinstance(job.payload, QLearningHistories)
    first, second = do(ad_run, job, worker="a"), do(ad_run, again, worker="b")
    digests = [wire.trajectory_digest(t) for t in first]
    assert digests == [wire.trajectory_digest(t) for t in second]
    assert [t.identity for t in first] == sorted((t.identity for t in first), key=lambda i: (i.trial, i.task, i.variation))
    assert {(t.origin, len(t.queries), t.policy_version) for t in first} == {("none", 0, -1)}
    other = do(ad_run, dataclasses.replace(job, seed=job.seed + 1))
    assert digests != [wire.trajectory_digest(t) for t in other]


def test_a_history_begins_without_knowledge_and_ends_near_the_optimum(ad_run: Run) -> None:
    """Of 60 episodes in a 5x5 room: the last five have 90% of the optimal return, the first a quarter of it; then anew."""
    made, optimum = [], []
    for job in jobs_of(ad_run):
        made += do(ad_run, job)
        optimum += [float(x) for x in optimal_returns(Hypotheses.of(job.variations))]
    returns = np.zeros(120)
    for t in made:
        returns[t.identity.trial] += t.episode_return / sum(optimum)
    for history in returns.reshape(2, 60):
        assert history[-5:].mean() > 0.9
        assert history[0] < 0.25
        assert np.all(np.diff(history.reshape(4, 15).mean(axis=1)) > 0), "it learns all the time"


def test_equally_good_actions_are_equally_probable() -> None:
    learner = QLearner(2, 3, 5, QLearning(epsilon=0.5, epsilon_end=0.0))
    learner.values[1, 4] = [2, 1, 2, 0, 0]
    at = np.array([[1, 1], [1, 1]], np.float32)
    np.testing.assert_allclose(learner.probabilities(at), [[0.2] * 5, [0.35, 0.1, 0.35, 0.1, 0.1]])
    learner.begin(1.0)
    np.testing.assert_allclose(learner.probabilities(at), [[0.2] * 5, [0.5, 0, 0.5, 0, 0]])


def test_histories_are_recorded_from_the_start_of_test_episodes(ad_run: Run) -> None:
    job = jobs_of(ad_run)[0]
    assert all(isinstance(v, Variation) and v.task.vector("start") == (0, 0) for v in job.variations)
