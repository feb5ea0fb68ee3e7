"""Action windows in the pretraining dataset and in training batches."""

import dataclasses

import numpy as np
import pytest

from icrl_dist.collect.adapt import Rollouts
from icrl_dist.methods import registry as methods
from icrl_dist.methods.examples import self_labelled
from icrl_dist.problems.darkroom.room import next_cell
from icrl_dist.problems.darkroom.solver import Hypotheses, cell_numbers, soft_labels
from icrl_dist.training import batches
from icrl_dist.training.batches import Examples, Pool
from tests.jobs import FixedWeights, do
from tests.models.windowed import HORIZON, LENGTH
from tests.optional import known


@pytest.fixture
def run(small_run):
    return dataclasses.replace(
        small_run,
        method="icag",
        pretrain=dataclasses.replace(small_run.pretrain, windows=2, decoy_fraction=0.5),
        model=dataclasses.replace(small_run.model, window=LENGTH),
        optim=dataclasses.replace(small_run.optim, windows=3),
    )


def pretraining_jobs(run, decoy_fraction):
    run = dataclasses.replace(run, pretrain=dataclasses.replace(run.pretrain, decoy_fraction=decoy_fraction))
    method = methods.of(run)
    return method.ask(run, method.phases(run)[0])


def followed(run, t):
    """Cells, actions, rewards and labels of a trajectory's windows."""
    outside = len(t.queries) - len(t.prev_actions)
    assert (outside, len(t.prev_actions)) == (run.pretrain.queries, 2 * LENGTH)
    cells = cell_numbers(t.queries[outside:], 3).reshape(2, LENGTH)
    return (
        cells,
        t.prev_actions.reshape(2, LENGTH),
        t.prev_rewards.reshape(2, LENGTH),
        t.labels[outside:].reshape(2, LENGTH, -1),
    )


@pytest.mark.parametrize("decoy_fraction", [0.0, 1.0])
def test_windows_are_played_in_the_variation_and_labelled_for_it(run, decoy_fraction):
    starts, right = set(), []
    for job in pretraining_jobs(run, decoy_fraction):
        for t in do(run, job):
            truth = soft_labels(
                Hypotheses.of([t.variation]), run.section("darkroom").gamma, run.section("darkroom").label_slack
            )[0]
            cells, prev_actions, prev_rewards, labels = followed(run, t)
            starts |= set(cells[:, 0].tolist())
            np.testing.assert_array_equal(labels, truth[cells])
            goal = int(t.variation.task.vector("goal")[0] * 3 + t.variation.task.vector("goal")[1])
            np.testing.assert_array_equal(prev_rewards[:, :-1] == 1, cells[:, 1:] == goal)
            if t.variation.adversary.kind == "null":
                np.testing.assert_array_equal(next_cell(3)[cells[:, :-1], prev_actions[:, :-1]], cells[:, 1:])
            right.append((np.take_along_axis(labels, prev_actions[:, :, None].astype(np.int64), axis=2) > 0).mean())
    assert starts == set(range(9))
    assert np.mean(right) == 1 if decoy_fraction == 0 else np.mean(right) < 0.9


def test_a_trajectorys_windows_do_not_depend_on_the_other_variations_of_the_job(run):
    job = pretraining_jobs(run, 0.5)[0]
    whole = {t.identity: t for t in do(run, job)}
    count = len(job.variations) // job.tasks
    for row, (task, k) in enumerate(job.rows()):
        single = dataclasses.replace(job, task=task, first=k, variations=job.variations[row : row + 1], tasks=1)
        for t in do(run, single):
            for name, array in t.arrays().items():
                np.testing.assert_array_equal(array, getattr(whole[t.identity], name), err_msg=name)
    assert count > 1


def test_training_draws_windows_of_the_contexts_variation():
    rng = np.random.default_rng(0)

    def examples(mark):
        states = np.full((4, LENGTH, 2), mark, np.float32) + np.arange(4, dtype=np.float32)[:, None, None] / 10
        of = batches.LabelledWindows(
            states, np.full((4, LENGTH), mark), states[..., 0], np.full((4, LENGTH, 5), mark, np.float32)
        )
        flat = np.full((6, HORIZON), mark)
        return Examples(
            flat,
            np.full((6, HORIZON + 1, 2), mark, np.float32),
            flat.astype(np.float32),
            states[:, 0],
            of.labels[:, 0],
            False,
            of,
        )

    pool = Pool(1.0, [examples(1), examples(2)], 3)
    chosen, prefixes = set(), set()
    for _ in range(30):
        batch = batches.draw(rng, [pool], 8, 2, windows=3)
        assert batch.windows is not None and batch.window_prefix is not None
        assert batch.windows.states.shape == (8, 3, LENGTH, 2)
        for row in range(8):
            mark = batch.actions[row, 0]
            assert (batch.windows.prev_actions[row] == mark).all() and (batch.windows.labels[row] == mark).all()
            assert ((batch.windows.states[row] // 1) == mark).all()
            np.testing.assert_array_equal(batch.windows.prev_rewards[row], batch.windows.states[row, :, :, 0])
        chosen |= set(np.round(batch.windows.states[:, :, 0, 0] % 1 * 10).astype(int).ravel().tolist())
        prefixes |= set(batch.window_prefix.ravel().tolist())
    assert chosen == {0, 1, 2, 3} and prefixes == set(range(3 * HORIZON + 1))
    with pytest.raises(ValueError, match="windows"):
        batches.draw(rng, [Pool(1.0, [dataclasses.replace(examples(1), windows=None)], 1)], 2, 2, windows=1)


def test_own_trials_are_cut_into_windows_that_do_not_cross_episodes(run):
    run = dataclasses.replace(run, method="icaa", icaa=dataclasses.replace(run.icaa, label_trials="later"))
    weights, method = FixedWeights(run), methods.of(run)
    job = method.ask(run, method.phases(run)[1])[0]
    assert isinstance(job.payload, Rollouts) and job.payload.deploy == "committed"
    made = [t for t in do(run, job, weights) if t.identity[2:4] == (job.task, 0)]
    of = known(known(self_labelled(run, made)).windows)
    later = made[run.icaa.context_trials + 1 :]
    expected = [(t, h) for t in later for h in range(0, run.section("darkroom").horizon // LENGTH * LENGTH, LENGTH)]
    assert len(of.states) == len(expected)
    for n, (t, h) in enumerate(expected):
        np.testing.assert_array_equal(of.states[n], t.observations[h : h + LENGTH])
        np.testing.assert_array_equal(of.prev_actions[n], t.actions[h : h + LENGTH])
        np.testing.assert_array_equal(of.prev_rewards[n], t.rewards[h : h + LENGTH])
        np.testing.assert_array_equal(of.labels[n].argmax(axis=1), t.actions[h : h + LENGTH])
