"""The code of discrete actions also learns and deploys vector actions."""

import numpy as np
import torch

from icrl_dist.agent.in_context_agent import InContextAgent
from icrl_dist.config.sections import ContextConfig, ModelConfig, OptimConfig
from icrl_dist.methods.dpt_loss import batch_loss
from icrl_dist.models.dpt import PretrainedTransformer
from icrl_dist.rollout.deployment import CommittedPolicy, InContextPolicy
from icrl_dist.rollout.episode import episode
from icrl_dist.training import batches, fit
from icrl_dist.training.batches import Examples, Pool
from icrl_dist.types import Spec, Step
from tests.models.windowed import LENGTH, trained


class Valley:
    """A toy problem: a point in [-1, 1]^2 moves by a fifth of its action; the reward is 1 near a hidden goal at the edge."""

    GOALS = np.array([[0.8, 0.0], [-0.8, 0.0], [0.0, 0.8], [0.0, -0.8]], np.float32)

    def __init__(self, goals):
        self.spec = Spec((-1.0, -1.0), (1.0, 1.0), actions=2, horizon=12, discrete=False)
        self.batch, self._goals = len(goals), self.GOALS[goals]

    def reset(self, rngs):
        self._h, self._at = 0, np.zeros((self.batch, 2), np.float32)
        return self._at

    def step(self, actions):
        assert actions.shape == (self.batch, 2) and np.abs(actions).max() <= 1
        self._h += 1
        self._at = np.clip(self._at + 0.2 * actions, -1, 1).astype(np.float32)
        near = (np.abs(self._at - self._goals).sum(axis=1) < 0.4).astype(np.float32)
        return Step(self._at, near, self._h == self.spec.horizon, np.full(self.batch, -1, np.int16))

    @classmethod
    def optimal(cls, states, goal):
        return np.clip(5 * (cls.GOALS[goal] - states), -1, 1).astype(np.float32)


class UniformPolicy(InContextPolicy):
    """Uniform actions, for comparison."""

    def act(self, observation, u):
        return (2 * u - 1).astype(np.float32)

    def observe(self, *transition):
        pass

    def append(self, *columns):
        pass


def examples(goal, rng, episodes):
    """Examples of one goal: walks toward random goals, and windows, some of which move toward another goal."""
    walks, states = [], rng.uniform(-1, 1, size=(64, 2)).astype(np.float32)
    for _ in range(episodes):
        env = Valley([goal])
        observations, actions, rewards = [env.reset(None)], list[np.ndarray](), []
        while len(actions) < 12:
            if len(actions) % 4 == 0:
                leads = rng.integers(0, 4, size=1)
            way = np.clip(Valley.optimal(observations[-1], leads) + rng.normal(size=(1, 2)) / 5, -1, 1).astype(np.float32)
            step = env.step(way)
            observations.append(step.observation)
            actions.append(way)
            rewards.append(step.reward)
        walks.append([np.concatenate(column) for column in (observations, actions, rewards)])
    at = rng.uniform(-1, 1, size=(32, 2)).astype(np.float32)
    guess = np.where(rng.random(32) < 0.3, rng.integers(0, 4, size=32), goal)
    path = [at]
    for _ in range(LENGTH):
        path.append(np.clip(path[-1] + 0.2 * Valley.optimal(path[-1], guess), -1, 1).astype(np.float32))
    along = np.stack(path, axis=1)
    near = (np.abs(along[:, 1:] - Valley.GOALS[goal]).sum(axis=2) < 0.4).astype(np.float32)
    of = batches.LabelledWindows(
        along[:, :-1], Valley.optimal(along[:, :-1], guess[:, None]), near, Valley.optimal(along[:, :-1], np.array(goal))
    )
    seen, acted, paid = (np.stack(column) for column in zip(*walks, strict=True))
    return Examples(acted, seen, paid, states, Valley.optimal(states, np.array(goal)), False, of)


def test_the_same_code_learns_and_deploys_vector_actions():
    rng = np.random.default_rng(0)
    spec = Valley([0]).spec
    torch.manual_seed(0)
    model = PretrainedTransformer(spec, ModelConfig(2, 1, 32, window=LENGTH))
    optim = OptimConfig(learning_rate=8e-3, muon=5.0, batch=16, queries=32, windows=8, episodes=2, beta2=0.98, warmup=20)
    pool = Pool(1.0, [examples(goal, rng, 30) for goal in range(4)], optim.episodes)
    opt = fit.Optimizer(model, optim)

    def loss(step):
        return batch_loss(model, batches.draw(np.random.default_rng(step), [pool], 16, 32, windows=8))

    fit.fit(model, opt, optim, 8e-3, 150, loss)
    goals, names = [0, 1, 2, 3] * 8, ("observations", "actions", "rewards")

    def earned(policy):
        for n in range(4):  # D_off: episodes of other policies
            seen = [examples(goal, np.random.default_rng((n, row)), 1) for row, goal in enumerate(goals)]
            states, actions, rewards = (np.concatenate([getattr(e, name) for e in seen]) for name in names)
            policy.append(states[:, :-1], actions, states[:, 1:], rewards)
        ran = [episode(Valley(goals), policy, np.random.default_rng(9 + n).spawn(32)) for n in range(3)]
        assert all(e.actions.dtype == np.float32 and e.actions.shape == (32, 12, 2) for e in ran)
        return np.mean([e.returns for e in ran])

    best = 12 - 3
    assert earned(CommittedPolicy(model, 32, ContextConfig())) > 0.6 * best
    assert earned(InContextPolicy(model, 32, ContextConfig())) > 0.6 * best
    assert earned(UniformPolicy(model, 32, ContextConfig())) < 0.25 * best
    agent = InContextAgent(trained(model), {}, seed=0)
    agent.reset_context(2)
    action = agent.act(np.zeros((2, 2)))
    assert action.shape == (2, 2)
    agent.observe(np.zeros((2, 2)), action, [0, 0], np.zeros((2, 2)), [False, False])
    with torch.no_grad():
        for parameter in model.parameters():
            parameter.copy_(parameter.flatten()[torch.randperm(parameter.numel())].view_as(parameter))
    assert earned(CommittedPolicy(model, 32, ContextConfig())) < 0.4 * best, (
        "the model learned nothing: shuffled weights are as good"
    )
