"""RARL and QARL: two SAC players in one batch of tasks, which learn in turn."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float, Float32

from icrl_dist.config.robust import RobustConfig
from icrl_dist.config.sac import SACConfig
from icrl_dist.experts.adversarial import schedule
from icrl_dist.experts.adversarial.curriculum import Curriculum, appended, discounted, with_temperature
from icrl_dist.experts.adversarial.schedule import PLAYERS, Player
from icrl_dist.experts.sac import draws
from icrl_dist.experts.sac.batched import SACBatch, has_update, require_finite
from icrl_dist.types import Spec, Step

if TYPE_CHECKING:
    from icrl_dist.problems.parts import TwoPlayerBatch

Report = Callable[["Players", Float[np.ndarray, " N"]], None]


@dataclasses.dataclass(frozen=True, eq=False)
class Players:
    """N protagonists, each with its adversary."""

    protagonist: SACBatch
    adversary: SACBatch
    curriculum: Curriculum | None
    """QARL's, by task; None for RARL, whose adversary tunes its temperature as SAC does."""

    def act(self, observations: Float[np.ndarray, "N *E S"]) -> Float32[np.ndarray, "N *E A"]:
        """The protagonists' mean actions; with a curriculum at temperature 0, the one of tests."""
        return self.protagonist.act(observations if self.curriculum is None else appended(observations))


def specs(spec: Spec, disturbance: int, config: RobustConfig, curriculum: bool) -> dict[Player, Spec]:
    """The spec of each player: both have the same observations, with a curriculum with the temperature."""
    shown = with_temperature(spec, config) if curriculum else spec
    return {"protagonist": shown, "adversary": dataclasses.replace(shown, actions=disturbance)}


def train(
    env: TwoPlayerBatch,
    sac: SACConfig,
    config: RobustConfig,
    seeds: Sequence[int],
    bounds: Float[np.ndarray, " N"] | None = None,
    progress: Report = lambda players, returns: None,
    device: str = "auto",
) -> Players:
    """Train a protagonist and an adversary in each of the N tasks of ``env``, in turn (``schedule.learner``).

    The game is zero-sum: the adversary's reward is minus the protagonist's.  Both act in every episode by samples, with
    uniformly random actions in the first ``sac.random_steps`` steps.  Every transition enters the replay of both; only
    the learner of an episode is updated.

    ``bounds``: QARL, with the discounted return of each task at which its curriculum moves; None: RARL.  ``progress`` is
    called after every episode with the players and the protagonists' returns.  All draws are keyed by a task's seed and
    the episode, so a task's players do not depend on the other tasks.  Raises ValueError for another number of
    seeds, FloatingPointError if actions or weights become NaN or infinite.
    """
    if len(seeds) != env.batch:
        raise ValueError(f"{len(seeds)} seeds for {env.batch} tasks: give one per task")
    horizon, count = env.spec.horizon, schedule.episodes(env.spec.horizon, sac, config)
    of = specs(env.spec, env.disturbance, config, bounds is not None)
    own = {player: [player_seed(seed, player) for seed in seeds] for player in PLAYERS}
    capacity = min(sac.replay, count * horizon)

    def player(name: Player) -> SACBatch:
        given = bounds is not None and name == "adversary"
        return SACBatch(own[name], of[name], sac, device, capacity=capacity, given_temperature=given)

    players = Players(player("protagonist"), player("adversary"), None if bounds is None else Curriculum(config, bounds))
    for episode in range(count):
        rewards = _episode(env, players, sac, of, own, episode, schedule.learner(episode, config))
        if players.curriculum is not None:
            players.curriculum.observe(discounted(rewards, sac.gamma))
        for one in (players.protagonist, players.adversary):
            require_finite(one.arrays["actor"].cpu().numpy(), one.steps)
        progress(players, rewards.sum(axis=1))
    return players


def player_seed(seed: int, player: Player) -> int:
    """The seed of one of a task's players; the adversary's differs from that of the protagonist and of a SAC expert."""
    words = draws.key(seed, draws.PLAYERS, PLAYERS.index(player)).generate_state(4, np.uint32)
    return int.from_bytes(words.tobytes(), "little")


def _episode(
    env: TwoPlayerBatch,
    players: Players,
    sac: SACConfig,
    of: dict[Player, Spec],
    seeds: dict[Player, list[int]],
    episode: int,
    learner: Player,
) -> Float[np.ndarray, "N H"]:
    """One episode of every task; ``learner`` is updated.  Returns the protagonists' rewards."""
    both: dict[Player, SACBatch] = {"protagonist": players.protagonist, "adversary": players.adversary}
    first = both[learner].steps
    updates = sum(has_update(sac, first + step) for step in range(1, env.spec.horizon + 1))
    drawn = {
        name: draws.EpisodeDraws(seeds[name], episode, of[name], sac, updates * (name == learner), one.device)
        for name, one in both.items()
    }
    waiting = iter(drawn[learner].updates)
    temperature = None
    if players.curriculum is not None:
        rngs = [np.random.default_rng(draws.key(seed, draws.TEMPERATURES, episode)) for seed in seeds["adversary"]]
        temperature = players.curriculum.temperatures(rngs)

    def shown(observation: np.ndarray) -> Float32[np.ndarray, "N S"]:
        return np.asarray(observation, np.float32) if temperature is None else appended(observation, temperature)

    observation, rewards = shown(env.reset(drawn["protagonist"].starts)), []
    for number in range(env.spec.horizon):
        actions = {name: _action(one, drawn[name], number, observation, sac) for name, one in both.items()}
        step = env.step(actions["protagonist"], actions["adversary"])
        step = step._replace(observation=shown(step.observation))
        for name, one in both.items():
            one.store(observation, actions[name], _of(step, name))
        if has_update(sac, both[learner].steps):
            both[learner].update_from_replay(*next(waiting))
        observation = step.observation
        rewards.append(step.reward)
    return np.stack(rewards, axis=1)


def _action(
    player: SACBatch, drawn: draws.EpisodeDraws, number: int, observation: Float32[np.ndarray, "N S"], sac: SACConfig
) -> Float32[np.ndarray, "N A"]:
    if player.steps < sac.random_steps:
        return drawn.uniform[number].astype(np.float32)
    action = player.act(observation, drawn.normal[number])
    require_finite(action, player.steps)
    return action


def _of(step: Step, player: Player) -> Step:
    """The step as this player sees it."""
    return step if player == "protagonist" else step._replace(reward=-step.reward)
