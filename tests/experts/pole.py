"""Trains one expert to balance the pole, in a separate process: the shape checks of tests make updates much slower.

Prints every 1,000 steps the mean return of its mean action over ten evaluation episodes, until 190.
"""

import sys
from typing import Any

import numpy as np
import torch

from icrl_dist.config.sac import SACConfig
from icrl_dist.experts.sac.batched import train
from icrl_dist.problems import registry
from icrl_dist.problems.dmc import domains
from icrl_dist.types import Variation


def main():
    torch.set_num_threads(1)
    pole = [Variation(domains.task("dmc-cartpole-balance"))]
    env = registry.batch(pole)
    rates: dict[str, Any] = dict.fromkeys(("actor_rate", "critic_rate", "temperature_rate"), 1e-3)
    config = SACConfig(hidden=(64, 64), batch=64, gamma=0.99, random_steps=1000, warmup=1000, update_every=1, **rates)

    def evaluate(experts, _):
        if experts.steps % 1000:
            return
        total = 0.0
        for episode in range(10):
            observation = env.reset([np.random.default_rng((1, episode))])
            for _ in range(200):
                observation, reward, *_ = env.step(experts.act(observation))
                total += float(reward[0])
        print(total / 10, flush=True)
        if total / 10 >= 190:
            sys.exit("torch's compiler was imported" if "torch._dynamo" in sys.modules else 0)

    train(registry.batch(pole), config, 12_000, [2], evaluate, "cpu")


if __name__ == "__main__":
    main()
