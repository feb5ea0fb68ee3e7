"""A corridor with a hidden goal cell, and an adversary that makes the agent slip."""

from dataclasses import dataclass

import numpy as np

from icrl_dist.collect.behavior import BehaviorContexts
from icrl_dist.config.ranges import Positive
from icrl_dist.interfaces import Behaviors, Contexts, LabelledQueries, Problem, Reference
from icrl_dist.rollout.policies import DiscretePolicy, RandomPolicy
from icrl_dist.types import NULL, Adversary, Spec, Split, Step, Task, Variation


@dataclass(frozen=True)
class CorridorConfig:
    cells: Positive = 6
    horizon: Positive = 8


class Corridor:
    def __init__(self, variations):
        self.spec, self.batch = spec(variations[0].task), len(variations)
        self.goal = np.array([v.task.number("goal") for v in variations])
        self.slip = np.array([v.adversary.number("p") if v.adversary != NULL else 0.0 for v in variations])

    def reset(self, rngs):
        self.h, self.cell = 0, np.array([rng.integers(int(self.spec.high[0]) + 1) for rng in rngs])
        self.noise = np.stack([rng.random(self.spec.horizon) for rng in rngs], axis=1)
        return self.cell[:, None].astype(np.float32)

    def step(self, actions):
        slipped = self.noise[self.h] < self.slip
        moved = np.where(slipped, 0, 2 * actions - 1)
        self.cell, self.h = np.clip(self.cell + moved, 0, int(self.spec.high[0])), self.h + 1
        reward = (self.cell == self.goal).astype(np.float32)
        done = self.h == self.spec.horizon
        return Step(self.cell[:, None].astype(np.float32), reward, done, np.where(slipped, 0, -1).astype(np.int16))


def spec(task):
    return Spec((0.0,), (task.number("cells") - 1.0,), actions=2, horizon=int(task.number("horizon")))


class CorridorProblem(Problem):
    section, Config, Labelling = "corridor", CorridorConfig, CorridorConfig

    def spec_of(self, task):
        return spec(task)

    def make_split(self):
        of = self.config
        tasks = [Task.of(self.name, cells=of.cells, horizon=of.horizon, goal=goal) for goal in range(of.cells)]
        return Split(tuple(tasks[:-1]), tuple(tasks[-1:]))

    def batch(self, variations):
        return Corridor(variations)

    def training_adversaries(self, rng, config):
        return tuple(Adversary.of("slip", p=float(rng.uniform(0, config.p_max))) for _ in range(config.count))

    def test_adversary(self, rng, strength, prior):
        return Adversary.of("slip", p=strength)

    def labelling(self, run):
        return self.config

    @property
    def labeller(self):
        return lambda job, labelling: lambda identities, rngs: [label(job.variation(i), labelling.cells) for i in identities]

    @property
    def behaviors(self):
        return Behaviors(("random", "leftward"), Walks)

    def contexts(self, run):
        return Contexts(BehaviorContexts(run.pretrain.behaviors, self.config))

    def references(self, run):
        return {"random": Reference(lambda rows, env: RandomPolicy(2))}


class Walks(DiscretePolicy):
    def __init__(self, names, rngs, env):
        left = np.array([0.5 if name == "random" else 0.8 for name in names])
        self.left_right = np.stack([left, 1 - left], axis=1)

    def probabilities(self, observation):
        return self.left_right

    def observe(self, *transition):
        pass


def label(variation: Variation, cells: int) -> LabelledQueries:
    states = np.arange(cells, dtype=np.float32)[:, None]
    labels = np.eye(2, dtype=np.float32)[(states[:, 0] < variation.task.number("goal")).astype(int)]
    return LabelledQueries(states, labels, np.zeros(0, np.int16), np.zeros(0, np.float32), "optimal")
