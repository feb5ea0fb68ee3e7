"""Robust policies of tasks: trained in games of two players, kept in the cache of experts, and what they are used for."""

from __future__ import annotations

import dataclasses
import logging
from collections.abc import Callable, Sequence

import numpy as np
from jaxtyping import Float, Float32, Float64

from icrl_dist.config.sac import SACConfig
from icrl_dist.experts import cache
from icrl_dist.experts.adversarial.curriculum import appended, discounted
from icrl_dist.experts.adversarial.payloads import Game
from icrl_dist.experts.cache import Stored, Trainer, expert_seed
from icrl_dist.experts.train import mean_actions, without_cache
from icrl_dist.experts.trajectories import Act, window_episodes
from icrl_dist.interfaces import Problem, Progress
from icrl_dist.storage.checkpoint import Checkpoint, load_checkpoint, save_checkpoint
from icrl_dist.storage.files import StoreError
from icrl_dist.types import Task, Variation

_log = logging.getLogger(__name__)


@dataclasses.dataclass(frozen=True, eq=False)
class Robust(Stored):
    """A robust policy of one task, its last adversary, and G undisturbed episodes after training."""

    actor: Float32[np.ndarray, " P"]
    """The protagonist's parameters, in the layout of ``experts.sac.stacked.Shape``."""
    adversary: Float32[np.ndarray, " Q"]
    """The adversary's parameters."""
    concentration: Float64[np.ndarray, ""]
    """QARL: concentration of the curriculum at the end; 0 for RARL."""
    bound: Float64[np.ndarray, ""]
    """QARL: the discounted return at which the curriculum moved; 0 for RARL."""
    returns: Float32[np.ndarray, " E"]
    """Undiscounted return of every training episode, against the adversary, both with exploration."""
    window_actions: Float32[np.ndarray, "G H A"]
    window_observations: Float32[np.ndarray, "G H+1 S"]
    window_rewards: Float32[np.ndarray, "G H"]
    window_labels: Float32[np.ndarray, "G H A"]
    """The policy's action at each of the first H states."""


def act_of(found: Sequence[Robust], sac: SACConfig, game: Game) -> Act:
    """The mean actions of these policies; with a curriculum at temperature 0."""
    observed = found[0].window_observations.shape[-1] + game.curriculum
    act = mean_actions(np.stack([one.actor for one in found]), (observed, found[0].window_actions.shape[-1]), sac)
    return (lambda states: act(appended(states))) if game.curriculum else act


def _trainer() -> Trainer:
    from icrl_dist.experts.sac.batched import pick

    return "lockstep, cuda" if pick("auto").type == "cuda" else "lockstep"


def _file_key(task: Task, horizon: int, sac: SACConfig, seed: int, game: Game, trainer: Trainer) -> str:
    return cache.key(Variation(task), horizon, sac, seed, trainer, game=game.key())


def load(task: Task, horizon: int, sac: SACConfig, seed: int, game: Game) -> Robust | None:
    """The task's robust policy from the cache, trained on any device; None if it is missing or damaged."""
    if not sac.cache:
        return None
    for trainer in ("lockstep", "lockstep, cuda"):
        try:
            path = cache.file(sac, _file_key(task, horizon, sac, seed, game, trainer))
            if path.exists():
                return Robust(**load_checkpoint(path).arrays)
        except (StoreError, OSError, TypeError) as error:
            _log.warning("the robust policy is trained again: %s", error)
    return None


Bounds = Callable[[Sequence[Task]], Float[np.ndarray, " N"]]
"""QARL's bound for each of these tasks: a discounted return."""


def robust_policies(
    tasks: Sequence[Task], problem: Problem, sac: SACConfig, game: Game, seed: int, bounds: Bounds, progress: Progress
) -> list[Robust]:
    """The robust policy of each task, from the cache; those that are missing are trained together and cached.

    ``bounds`` is called for the missing tasks of QARL.  Raises RuntimeError for a task whose simulation diverges in every
    episode after training.
    """
    horizon = problem.spec_of(tasks[0]).horizon
    cached = {task: load(task, horizon, sac, seed, game) for task in tasks}
    found = {task: one for task, one in cached.items() if one is not None}
    missing = [task for task in cached if task not in found]
    if found:
        progress(f"{len(found)} robust policies from the cache", note=True)
    if missing:
        if reason := cache.unusable(sac):  # found before the training, which may take hours
            sac = without_cache(sac, reason, progress)
        at = bounds(missing) if game.curriculum else None
        for task, one in zip(missing, _train(missing, problem, sac, game, seed, at, progress), strict=True):
            found[task] = one
            if not sac.cache:
                continue
            try:
                path = cache.file(sac, _file_key(task, horizon, sac, seed, game, _trainer()))
                save_checkpoint(path, Checkpoint(one.arrays(), {"of": str(task), "curriculum": game.curriculum}))
            except StoreError as error:
                sac = without_cache(sac, cache.unusable(sac) or str(error), progress)
    return [found[task] for task in tasks]


def expert_bounds(rewards: Sequence[Float[np.ndarray, "G H"]], gamma: float, share: float) -> Float64[np.ndarray, " N"]:
    """This share of the mean discounted return of each expert, from the rewards of its undisturbed episodes."""
    return share * np.array([discounted(one, gamma).mean() for one in rewards])


def _train(
    tasks: Sequence[Task],
    problem: Problem,
    sac: SACConfig,
    game: Game,
    seed: int,
    bounds: Float[np.ndarray, " N"] | None,
    progress: Progress,
) -> list[Robust]:
    from icrl_dist.experts.adversarial.train import Players, train

    assert problem.second_player is not None, "a job needs it"
    variations = [Variation(task) for task in tasks]
    seeds, returns = [expert_seed(variation, seed) for variation in variations], list[np.ndarray]()

    def report(players: Players, total: np.ndarray) -> None:
        returns.append(total.astype(np.float32))
        steps, mean = players.protagonist.steps, f"mean return {total.mean():.0f}"
        progress(f"{len(tasks)} games at {steps:,} steps, {mean}", reached=steps)

    env = problem.second_player.batch(tasks, game.strength)
    players = train(env, sac, game.settings, seeds, bounds, report)
    windows = window_episodes(problem.batch(variations), problem, players.act, seeds, range(len(tasks)))
    whole = windows.pop("whole")
    for task, one in zip(tasks, whole, strict=True):
        if not one.any():
            raise RuntimeError(f"{task}: the simulation diverges in every episode of its robust policy; use another task")
    actors = [one.arrays["actor"].cpu().numpy() for one in (players.protagonist, players.adversary)]
    reached = np.zeros(len(tasks)) if players.curriculum is None else players.curriculum.concentrations
    at = np.zeros(len(tasks)) if bounds is None else bounds
    return [
        Robust(
            actor=actors[0][row],
            adversary=actors[1][row],
            concentration=np.array(reached[row]),
            bound=np.array(at[row]),
            returns=np.stack(returns)[:, row],
            **{f"window_{name}": column[row][whole[row]] for name, column in windows.items()},
        )
        for row in range(len(tasks))
    ]
