"""The best of the last checkpoints of a training acts as the expert, against a slow loop."""

import dataclasses

import numpy as np
import pytest
import torch

from icrl_dist.experts import cache, checkpoints, train
from icrl_dist.experts.checkpoints import Checkpoints, evaluate
from icrl_dist.experts.payloads import ExpertHistories, ExpertLabelling, checkpoint_numbers
from icrl_dist.experts.sac import batched, draws
from icrl_dist.experts.sac.batched import SACBatch
from icrl_dist.storage.checkpoint import save_checkpoint
from tests.experts.histories import EPISODES, HORIZON, KilledError, digests, run
from tests.experts.sac_cases import LINE, DivergingLine, Line
from tests.jobs import do, jobs_of
from tests.optional import known

__all__ = ["run"]

SEEDS = (5, 6, 7)


@pytest.mark.parametrize(
    ("count", "episodes", "taken"),
    [
        (1, 100, [100]),
        (2, 100, [80, 100]),
        (5, 100, [80, 85, 90, 95, 100]),
        (5, 10, [8, 9, 10]),
        (3, 4, [4]),
        (3, 1, [1]),
    ],
)
def test_checkpoints_are_evenly_spaced_in_the_last_fifth_and_end_with_the_training(count, episodes, taken):
    assert checkpoint_numbers(dataclasses.replace(LINE, checkpoints=count), episodes) == taken


def test_the_steps_of_the_evaluations_are_counted():
    def steps(**settings):
        sac = dataclasses.replace(LINE, steps=100 * 7, **settings)
        return ExpertHistories(sac, ExpertLabelling(1, 1, 0, 0.0)).env_steps(3, 7)

    assert steps(checkpoints=5, checkpoint_episodes=2) - steps() == 5 * 2 * 7
    assert steps(checkpoint_episodes=2) == steps()


def slow_choice(kept, episodes):
    """The parameters of every expert, one expert, checkpoint and episode after another."""
    chosen = []
    for row, seed in enumerate(SEEDS):
        best, most = kept[0][row], -np.inf
        for actors in kept:
            alone, total = SACBatch([0], Line(1).spec, LINE, "cpu"), 0.0
            alone.arrays["actor"].copy_(torch.from_numpy(actors[row : row + 1]))
            for episode in range(episodes):
                env = Line(1)
                observation = env.reset([np.random.default_rng(draws.key(seed, draws.CHECKPOINTS, episode))])
                for _ in range(env.spec.horizon):
                    step = env.step(alone.act(observation))
                    observation, total = step.observation, total + float(step.reward[0])
            if total >= most:
                best, most = actors[row], total
        chosen.append(best)
    return np.stack(chosen)


def test_every_expert_gets_the_parameters_of_its_best_checkpoint():
    config = dataclasses.replace(LINE, checkpoints=3, checkpoint_episodes=4)
    kept = [SACBatch(range(9 * n, 9 * n + 3), Line(3).spec, LINE, "cpu").arrays["actor"].numpy() for n in range(3)]
    experts = SACBatch(SEEDS, Line(3).spec, LINE, "cpu")
    kept[2][1] = kept[0][1]  # equal returns: the last one
    _, bias = experts.actor_shape.layers(torch.from_numpy(kept[2]))[-1]
    bias[0] -= 9.0  # damaged: it always moves to lower rewards
    taken = Checkpoints(config, 15)
    numbers = checkpoint_numbers(config, 15)
    for episode in range(1, 16):
        taken.keep(episode, kept[numbers.index(episode)] if episode in numbers else np.full_like(kept[0], np.nan))
    again = Checkpoints(config, 15)
    again.load(taken.state())
    texts = list[str]()
    again.choose(Line(3), SEEDS, experts, texts.append)
    chosen = experts.arrays["actor"].numpy()
    np.testing.assert_array_equal(chosen, slow_choice(kept, 4))
    assert not np.array_equal(chosen[0], kept[2][0]) and not np.array_equal(chosen, kept[2])
    assert texts == [f"evaluating checkpoint {n} of 3" for n in (1, 2, 3)]


def test_rewards_after_a_divergence_count_as_nothing():
    returns = evaluate(DivergingLine(2), lambda observation: np.zeros((2, 1), np.float32), (1, 2), draws.EVALUATION, 3)
    whole = evaluate(Line(2), lambda observation: np.zeros((2, 1), np.float32), (1, 2), draws.EVALUATION, 3)
    np.testing.assert_allclose(returns[:, 0], whole[:, 0])
    np.testing.assert_allclose(returns[:, 1], whole[:, 1] * 2 / 7, rtol=1e-6)


@pytest.fixture
def several(run):
    """The run with three checkpoints per training, after episodes 8, 9 and 10."""
    return dataclasses.replace(run, sac=dataclasses.replace(run.sac, checkpoints=3, checkpoint_episodes=2))


@pytest.mark.integration
def test_an_expert_whose_last_parameters_are_damaged_is_delivered_as_it_was_before(several, monkeypatch):
    job, real, seen = jobs_of(several)[0], batched.train, {}

    def damaging(env, config, steps, seeds, progress, **more):
        def watched(experts, returns):
            if experts.steps == steps:
                experts.arrays["actor"][1] = 0.0
            seen[experts.steps // HORIZON] = experts.arrays["actor"].numpy().copy()
            progress(experts, returns)

        return real(env, config, steps, seeds, watched, **more)

    def whole(env, act, seeds, purpose, episodes):
        assert (purpose, episodes) == (draws.CHECKPOINTS, 2)
        return np.tile(act.__self__.arrays["actor"].any(dim=1).double().numpy(), (episodes, 1))

    monkeypatch.setattr(batched, "train", damaging)
    monkeypatch.setattr(checkpoints, "evaluate", whole)
    sent = do(several, job)
    found = [known(cache.load_any(v, HORIZON, several.sac, several.seed)) for v in job.variations]
    for row, history in enumerate(found):
        np.testing.assert_array_equal(history.actor, seen[EPISODES - 1 if row == 1 else EPISODES][row])
    assert not seen[EPISODES][1].any() and seen[EPISODES][0].any()
    of_row = [t for t in sent if t.variation == job.variations[1]]
    policy = train.ExpertPolicy([found[1]] * 6, several.sac)
    for t in of_row:  # labels are those of the expert that is kept
        np.testing.assert_allclose(t.labels, policy.act(t.queries, np.zeros((6, 2))), atol=1e-5)
    assert np.abs(of_row[0].labels).max() > 0


@pytest.mark.integration
def test_a_killed_training_chooses_among_the_same_checkpoints(several, monkeypatch):
    job = jobs_of(several)[0]
    without = dataclasses.replace(several, sac=dataclasses.replace(several.sac, cache=""))
    undisturbed, begun = digests(do(without, jobs_of(without)[0])), list[str]()
    monkeypatch.setattr(train, "CHECKPOINT_S", 0.0)

    def killed(path, checkpoint):
        save_checkpoint(path, checkpoint)
        begun.append(path.name)
        if len(begun) in (4, 9):  # the second time after two checkpoints
            raise KilledError

    monkeypatch.setattr(train, "save_checkpoint", killed)
    for _ in range(2):
        with pytest.raises(KilledError):
            do(several, job)
    assert digests(do(several, job)) == undisturbed
