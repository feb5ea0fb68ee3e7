"""A Dark Room game without a model: a fake clock and an agent that always takes the same action."""

import numpy as np

from icrl_dist.agent.in_context_agent import InContextAgent
from icrl_dist.problems.darkroom.game import PlayGame

RIGHT, LEFT, UP, DOWN, STAY = range(5)


class Clock:
    now = 100.0

    def __call__(self):
        return self.now


class Agent(InContextAgent):
    """An agent without a model: it always takes the same action and records the transitions that it observes."""

    def __init__(self, action=UP, deploy="committed"):
        self.outcomes, self.action, self.deploy = None, action, deploy
        self.manifest, self.observed, self.resets = {"test_goals": [[2, 1]]}, [], 0

    def reset_context(self, batch=1):
        self.observed.clear()
        self.resets += 1

    def act(self, observation):
        return np.array([self.action])

    def observe(self, *transition):
        self.observed.append(tuple(np.asarray(column)[0] for column in transition))

    def distribution(self, states, row=0):
        return np.full((len(states), 5), 0.2)

    def context(self, row=0):
        ended = [i for i, t in enumerate(self.observed) if t[4]]
        known = self.observed if self.deploy == "committed" else self.observed[: ended[-1] + 1 if ended else 0]
        before, action, reward, after = (np.array([t[i] for t in known]) for i in range(4))
        return before.reshape(-1, 2), action.astype(np.int64), after.reshape(-1, 2), reward


def game(run, agent=None, seed=0, clock=None):
    return PlayGame(agent or Agent(), run, seed, clock or Clock())
