"""Robust policies of a problem with a second player: how a run trains them, and those in the cache as reference agents."""

from __future__ import annotations

from typing import TYPE_CHECKING

from icrl_dist.config.toml import ConfigError
from icrl_dist.experts.adversarial.payloads import Game
from icrl_dist.interfaces import MakePolicy, Problem

if TYPE_CHECKING:
    from icrl_dist.config.run import Run

KEYS = {"rarl": False, "qarl": True}
"""Keys of the reference agents, and whether their training has a curriculum."""


def game(problem: Problem, run: Run, curriculum: bool) -> Game:
    """The game that the run's robust policies are trained in.

    Raises ConfigError for a problem without a second player, and for a strength that is not known.
    """
    if problem.second_player is None:
        raise ConfigError(f"problem = {problem.name!r}: it has no second player (Problem.second_player)")
    return Game(problem.second_player.strength, run.section("robust"), curriculum)


def policies_of(problem: Problem, run: Run, curriculum: bool) -> MakePolicy | None:
    """The robust policies of the evaluated tasks; None unless all of them are in the cache of this node."""
    from icrl_dist.experts.adversarial import policies
    from icrl_dist.experts.train import MeanPolicy

    if not hasattr(run, "robust"):
        return None
    of, found = game(problem, run, curriculum), {}
    for task in problem.evaluated:
        one = policies.load(task, problem.horizon, run.sac, run.seed, of)
        if one is None:
            return None
        found[task] = one
    return lambda rows, env: MeanPolicy(policies.act_of([found[row.task] for row in rows], run.sac, of))
