"""A deployed decision transformer: its returns-to-go, its window and its prompt, against a policy that computes all anew."""

from __future__ import annotations

import copy
from typing import Literal

import numpy as np
import pytest
import torch

from icrl_dist.config.run import ConfigError
from icrl_dist.config.sections import ContextConfig, ModelConfig
from icrl_dist.models.dt import DecisionTransformer
from icrl_dist.models.segments import Segments
from icrl_dist.rollout.prompted import PromptedPolicy, best_steps, prompted
from icrl_dist.types import Spec

SPEC = Spec((0.0, 0.0), (4.0, 4.0), actions=3, horizon=6)
B, W, P, H = 3, 3, 2, 6


def model(target: float = 5.0, window: int = W) -> DecisionTransformer:
    torch.manual_seed(0)
    made = DecisionTransformer(SPEC, ModelConfig(layers=2, width=16), window, P)
    made.target.fill_(target)
    made.scale.fill_(2.0)
    return made.eval()


def episode(seed: int, length: int = H) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """States (one more than steps), actions and rewards."""
    rng = np.random.default_rng(seed)
    states = rng.integers(0, 5, (B, length + 1, 2)).astype(np.float32)
    return states, rng.integers(0, 3, (B, length)), rng.integers(0, 3, (B, length)).astype(np.float32)


def slow(one: DecisionTransformer, prompt: Segments | None, ran: tuple[np.ndarray, ...], h: int, window: int = W) -> np.ndarray:
    """The distributions at step h of an episode, row by row, without anything kept from earlier steps."""
    states, actions, rewards = ran
    found = []
    for row in range(B):
        steps = list(range(max(0, h + 1 - window), h + 1))
        segments = Segments(
            np.array([[5.0 - rewards[row, :k].sum() for k in steps]], np.float32),
            states[row : row + 1, steps],
            np.array([[actions[row, k] if k < h else 0 for k in steps]]),
            np.array([[min(k, H - 1) for k in steps]]),
            np.ones((1, len(steps)), bool),
        )
        empty = Segments(*(np.zeros((1, P, *tail), kind) for tail, kind in SHAPES))
        own = empty if prompt is None else Segments(*(column[row : row + 1] for column in prompt))
        with torch.no_grad():
            found.append(one(one.encode(own), segments)[0, -1].softmax(-1).numpy())
    return np.stack(found)


SHAPES = (((), np.float32), ((2,), np.float32), ((), np.int64), ((), np.int64), ((), bool))


def pieces(ran: tuple[np.ndarray, ...], rows: list[int]) -> Segments:
    """The best P steps of the episode in these rows, and no prompt in the others."""
    states, actions, rewards = ran
    made = Segments(*(np.zeros((B, P, *tail), kind) for tail, kind in SHAPES))
    for row in rows:
        sums = [rewards[row, k : k + P].sum() for k in range(rewards.shape[1] - P + 1)]
        first = sums.index(max(sums))
        for place, k in enumerate(range(first, first + P)):
            made.to_go[row, place] = rewards[row, k:].sum()
            made.observations[row, place], made.actions[row, place] = states[row, k], actions[row, k]
            made.steps[row, place], made.valid[row, place] = k, True
    return made


def play(policy: PromptedPolicy, ran: tuple[np.ndarray, ...], check: Segments | None, window: int = W) -> None:
    states, actions, rewards = ran
    length = rewards.shape[1]
    for h in range(length):
        expected = slow(policy.model, check, ran, h, window)
        other = np.flip(states[:, h], axis=0).copy()
        policy.probabilities(other)  # a decision that nothing follows leaves no trace
        np.testing.assert_allclose(policy.probabilities(states[:, h]), expected, atol=1e-5)
        for row in range(B):
            np.testing.assert_allclose(policy.distribution(states[[row, row], h], row)[1], expected[row], atol=1e-5)
        policy.observe(states[:, h], actions[:, h], rewards[:, h], states[:, h + 1], h == length - 1)


@pytest.mark.parametrize("window", [1, W, 2 * H])
def test_every_decision_is_that_of_a_policy_which_keeps_nothing(window: int) -> None:
    """Two episodes: the first without a prompt, the second with the best steps of the first."""
    policy = PromptedPolicy(model(window=window), B, ContextConfig())
    first, second = episode(1), episode(2)
    play(policy, first, None, window)
    play(policy, second, pieces(first, [0, 1, 2]), window)


def test_the_prompt_is_of_the_best_episode_of_each_environment_also_of_an_appended_one() -> None:
    policy = PromptedPolicy(model(), B, ContextConfig())
    first, second, third = episode(1), episode(2), episode(3)
    first[2][:], second[2][:] = 1.0, 0.0
    second[2][1, 3], third[2][:] = 7.0, 0.5
    play(policy, first, None)
    states, actions, rewards = second
    policy.append(states[:, :-1], actions, states[:, 1:], rewards)
    expected = Segments(
        *(
            np.where(np.isin(np.arange(B), [1]).reshape(-1, *[1] * (a.ndim - 1)), b, a)
            for a, b in zip(pieces(first, [0, 1, 2]), pieces(second, [0, 1, 2]), strict=True)
        )
    )
    play(policy, third, expected)
    play(policy, episode(4), expected)


def test_with_keep_last_the_prompt_is_of_the_newest_episode() -> None:
    policy = PromptedPolicy(model(), B, ContextConfig(keep="last"))
    first, second = episode(1), episode(2)
    first[2][:] = 9.0
    play(policy, first, None)
    play(policy, second, pieces(first, [0, 1, 2]))
    play(policy, episode(3), pieces(second, [0, 1, 2]))


@pytest.mark.parametrize(("keep", "kept"), [("all", [2, 3]), ("last", [3])])
def test_its_context_holds_the_newest_ended_episodes_as_those_of_other_policies_do(
    keep: Literal["all", "last"], kept: list[int]
) -> None:
    """At most ``context.max`` transitions; a running episode is not in it, one that was appended is."""
    policy = PromptedPolicy(model(), B, ContextConfig(max=2 * H, keep=keep))
    assert [column.shape for column in policy.context(1)] == [(0, 2), (0,), (0, 2), (0,)]
    episodes = {seed: episode(seed) for seed in (1, 2, 3)}
    play(policy, episodes[1], None)
    states, actions, rewards = episodes[2]
    policy.append(states[:, :-1], actions, states[:, 1:], rewards)
    states, actions, rewards = episodes[3]
    for h in range(H):
        assert len(policy.context()[1]) == (H if keep == "last" else 2 * H)
        policy.act(states[:, h], np.full((B, 1), 0.5))
        policy.observe(states[:, h], actions[:, h], rewards[:, h], states[:, h + 1], h == H - 1)
    for row in range(B):
        columns = [[s[row, :-1], a[row], s[row, 1:], r[row]] for s, a, r in (episodes[seed] for seed in kept)]
        for found, expected in zip(policy.context(row), zip(*columns, strict=True), strict=True):
            np.testing.assert_array_equal(found, np.concatenate(expected))
        assert [column.dtype.kind for column in policy.context(row)] == ["f", "i", "f", "f"]


def test_longer_and_shorter_episodes_than_in_training_can_be_played() -> None:
    policy = PromptedPolicy(model(), B, ContextConfig())
    play(policy, episode(1, H + 3), None)
    short = PromptedPolicy(model(), B, ContextConfig())
    play(short, episode(1, 1), None)
    assert short._prompt.valid.tolist() == [[True, False]] * B


def test_the_best_steps_are_the_first_with_the_largest_sum() -> None:
    rewards = np.array([[0, 1, 0, 0, 1, 0], [0, 0, 0, 2, 2, 0]], np.float32)
    assert best_steps(rewards, 2).tolist() == [[0, 1], [3, 4]]


def test_the_weights_are_those_of_the_start_and_a_copy_acts_like_the_original() -> None:
    one = model()
    policy, states = PromptedPolicy(one, B, ContextConfig()), episode(1)[0]
    before = policy.probabilities(states[:, 0])
    copied = copy.copy(policy)
    with torch.no_grad():
        one.head.weight.zero_()
        policy.model.head.bias.add_(torch.tensor([5.0, 0, 0]))
    assert abs(policy.probabilities(states[:, 0]) - before).max() > 0.01
    np.testing.assert_array_equal(copied.probabilities(states[:, 0]), before)


def test_actions_depend_on_the_target_return() -> None:
    states = episode(1)[0]
    found = [PromptedPolicy(model(target), B, ContextConfig()).probabilities(states[:, 0]) for target in (0.0, 5.0)]
    assert abs(found[0] - found[1]).max() > 0.01


def test_another_rule_is_refused() -> None:
    with pytest.raises(ConfigError, match=r"deploy = 'committed'.*leave deploy out"):
        prompted(model(), B, ContextConfig(), "committed")
