"""SAC experts of the variations of a continuous game, and the histories of how they came to be (appendix C.3).

What a variation is learned from: episodes of its expert's training, from the first random ones to
the last, and at every state of them the action of the expert that came of it.  Expert networks
never travel; histories and experts are kept where they were made, by what they are of, so that
nobody trains them twice.
"""

from __future__ import annotations

import hashlib
import logging
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np
from jaxtyping import Float32

from icrl_dist import envs
from icrl_dist.envs import Batch
from icrl_dist.envs.recorder import Recorder
from icrl_dist.files import Checkpoint, StoreError, load_checkpoint, save_checkpoint
from icrl_dist.games import SACConfig
from icrl_dist.histories import KEPT, LED, History, file, keep, kept, key, sac_of
from icrl_dist.types import Identity, Job, Spec, Trajectory

if TYPE_CHECKING:
    from icrl_dist.algos.sac_batch import By, SACBatch

_log = logging.getLogger(__name__)

CHECKPOINT_S = 60.0
"""A training that is under way is written down so often; after a kill it goes on from there."""


class Tell(Protocol):
    """Hears how long work goes on; what is a ``note`` is worth a line of its own."""

    def __call__(self, text: str, note: bool = False) -> None: ...


def unheard(text: str, note: bool = False) -> None:
    """Nobody listens."""


def train_expert(job: Job, worker: str, tell: Tell = unheard) -> Iterator[Trajectory]:
    """Histories D^{i,k} of SAC experts of each variation, query states and labels (Algorithm 2, lines 8 to 12).

    All of a job's experts train together, in lockstep; they, and so the histories, are known when
    the last step is made.  Settings: those of ``settings``; ``queries`` a trajectory; ``stretches``
    a trajectory, of ``stretch`` states, a share ``misled`` of them led by another's expert.  Raises
    RuntimeError for a variation whose simulation keeps breaking down.
    """
    yield from delivered(job, _histories(job, sac_of(job), tell), worker)


def delivered(job: Job, found: Sequence[History], worker: str) -> Iterator[Trajectory]:
    """``job.trials`` episodes of each variation's history, evenly spaced, with query states and labels."""
    for row, (task, variation) in enumerate(job.rows()):
        history = found[row]
        chosen = np.linspace(0, len(history.rewards) - 1, job.trials).round().astype(int)
        for trial, episode in enumerate(chosen.tolist()):
            identity = Identity(job.stage, job.round, task, variation, trial)
            yield Trajectory(
                identity=identity,
                variation=job.variation(identity),
                weights=job.weights,
                digest="",
                worker=worker,
                observations=history.observations[episode],
                actions=history.actions[episode],
                rewards=history.rewards[episode],
                adversary=history.adversary[episode],
                origin="expert",
                **_known(job, history, identity.rng(job.seed)),
            )


def _known(job: Job, history: History, rng: np.random.Generator) -> dict[str, np.ndarray]:
    """Query states of the history and stretches of what experts led, with their labels: a trajectory's last arrays."""
    queries, stretches, length = (int(str(job.setting(name))) for name in ("queries", "stretches", "stretch"))
    place = np.unravel_index(rng.integers(history.rewards.size, size=queries), history.rewards.shape)
    wrong = rng.random(stretches) < float(str(job.setting("misled")))
    right_ones, wrong_ones = np.flatnonzero(~history.led_wrong), np.flatnonzero(history.led_wrong)
    led, at = [], []
    for misled in wrong.tolist():
        episodes = wrong_ones if misled and len(wrong_ones) else right_ones
        led += [int(rng.choice(episodes))] * length
        first = int(rng.integers(history.led_rewards.shape[1] - length + 1))
        at += list(range(first, first + length))
    rest = np.array(led, int), np.array(at, int)
    return {
        "queries": np.concatenate([history.observations[:, :-1][place], history.led_observations[:, :-1][rest]]),
        "labels": np.concatenate([history.labels[place], history.led_labels[rest]]),
        "taken": history.led_actions[rest],
        "gained": history.led_rewards[rest],
    }


def _histories(job: Job, config: SACConfig, tell: Tell) -> list[History]:
    """Of each of the job's variations: from the cache if all are there, else of a training of all of them.

    The batch belongs to the job, as everywhere: experts that trained in other company differ in
    their last digits.
    """
    found = [kept(variation, config, job.seed) for variation in job.variations]
    whole = [history for history in found if history is not None]
    if len(whole) == len(found):
        saved = f"{len(whole) * config.steps:,} steps of SAC saved"
        tell(f"{job.label}: {len(whole)} experts from the cache, {saved}", note=True)
        return whole
    made = _train(job, config, tell)
    for variation, history in zip(job.variations, made, strict=True):
        keep(history, variation, config, job.seed)
    return made


def trained_by(experts: int) -> By:
    """stable-baselines3, the reference, trains an expert that is alone; several train in lockstep, and so does one on a GPU."""
    from icrl_dist.algos.sac_batch import pick

    return "stable-baselines3" if experts == 1 and pick("auto").type == "cpu" else "lockstep"


def _train(job: Job, config: SACConfig, tell: Tell) -> list[History]:
    from icrl_dist.algos.sac_batch import train

    names = [key(variation, config, job.seed) for variation in job.variations]
    part = file(config, "part-" + hashlib.sha256("".join(names).encode()).hexdigest()) if config.cache else None
    env = envs.batch(job.variations)
    recorder = Recorder(env, max(1, config.steps // env.spec.horizon), KEPT)
    state = _resumed(part, recorder) if part is not None and part.exists() else None
    written = time.monotonic()

    def progress(experts: SACBatch, returns: np.ndarray) -> None:
        nonlocal written
        mean = f"mean return {returns.mean():.0f}"
        tell(f"{len(names)} experts at {experts.steps:,} of {config.steps:,} steps, {mean}")
        if part is not None and time.monotonic() - written >= CHECKPOINT_S:
            arrays = {f"state/{name}": value for name, value in experts.state().items()}
            arrays |= {f"episodes/{name}": value for name, value in recorder.state().items()}
            save_checkpoint(part, Checkpoint(arrays, {}))
            written = time.monotonic()

    rng = Identity(job.stage, job.round, job.task, job.first, 0).rng(job.seed)
    seed, chance = int(rng.integers(2**31)), int(rng.integers(2**31))
    experts = train(
        recorder, config, recorder.episodes * recorder.spec.horizon, seed, progress, state=state, by=trained_by(env.batch)
    )
    columns, led = labelled(recorder.columns(), experts), lead(env, experts, chance)
    made = assembled(job, columns, led, experts.arrays["actor"].cpu().numpy(), tell)
    if part is not None:
        part.unlink(missing_ok=True)
    return made


def assembled(
    job: Job, columns: dict[str, np.ndarray], led: dict[str, np.ndarray], actors: np.ndarray, tell: Tell
) -> list[History]:
    """The history of each variation, without the episodes that broke down.

    Raises RuntimeError for a variation of which nothing is left.
    """
    parts, made = {"": columns, "led_": led}, []
    for row, variation in enumerate(job.variations):
        whole = {prefix: of["whole"][row] for prefix, of in parts.items()}
        lost = sum(int((~one).sum()) for one in whole.values())
        if lost:
            tell(f"{job.label}: {lost} episodes of {variation} broke down, and are left out", note=True)
        broken = not all(one.any() for one in whole.values() if len(one))
        if broken or (led["wrong"].size and led["wrong"][row][whole["led_"]].all()):
            raise RuntimeError(f"{variation}: its simulation breaks down in every episode; leave it out, or push it less")
        taken = {
            prefix + name: column[row][whole[prefix]]
            for prefix, of in parts.items()
            for name, column in of.items()
            if name != "whole"
        }
        made.append(History(**taken, actor=actors[row]))
    return made


def labelled(columns: dict[str, np.ndarray], experts: SACBatch | None) -> dict[str, np.ndarray]:
    """Episodes with the right action at each of their states in place of the true states."""
    truths = columns.pop("truths", None)
    if truths is None:
        assert experts is not None, "a game without a scripted policy"
        seen = columns["observations"][:, :, :-1]
        labels = experts.act(seen.reshape(len(seen), -1, seen.shape[-1]), None, deterministic=True)
    else:
        labels = scripted(truths)
    return {**columns, "labels": labels.reshape(columns["actions"].shape)}


def lead(env: Batch, experts: SACBatch | None, seed: int) -> dict[str, np.ndarray]:
    """``LED`` episodes in which each row's own expert acts, and, if there are several, as many in which the next row's does."""
    count = env.batch
    recorder = Recorder(env, episodes := 2 * LED if count > 1 else LED, episodes)
    for episode in range(episodes):
        by = np.roll(np.arange(count), -int(episode >= LED))  # row r follows expert by[r]
        seen = recorder.reset(
            [np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(episode, r))) for r in range(count)]
        )
        for _ in range(env.spec.horizon):
            seen = recorder.step(_led_by(by, seen, getattr(env, "truth", None), experts)).observation
    wrong = np.broadcast_to(np.arange(episodes) >= LED, (count, episodes))
    columns = labelled(recorder.columns(), experts)
    del columns["adversary"]  # zeta holds nothing of it
    return {**columns, "wrong": wrong}


def _led_by(
    by: np.ndarray, seen: Float32[np.ndarray, "B S"], truth: np.ndarray | None, experts: SACBatch | None
) -> Float32[np.ndarray, "B A"]:
    """What the expert ``by[r]`` does in row r; Meta-World's is the scripted policy that is told that row's goal."""
    if truth is not None:
        return scripted(np.concatenate([truth[:, :-3], truth[by, -3:]], axis=1))
    assert experts is not None, "a game without a scripted policy"
    asked = np.empty_like(seen)
    asked[by] = seen
    return experts.act(asked, None, deterministic=True)[by]


def _resumed(part: Path, recorder: Recorder) -> dict[str, np.ndarray] | None:
    """The state of a training that was under way; None if it cannot be read."""
    try:
        stored = load_checkpoint(part)
        recorder.load(stored.part("episodes"))
        return stored.part("state")
    except (StoreError, KeyError) as error:
        _log.warning("this training begins anew: %s", error)
        return None


def scripted(truths: np.ndarray) -> Float32[np.ndarray, "N A"]:
    """Meta-World's scripted policy at these true states."""
    from icrl_dist.envs.metaworld import expert

    return expert(truths.reshape(-1, truths.shape[-1]).astype(np.float64))


class ExpertPolicy:
    """The experts of B variations, each in its row: means of their actions, by ``History.actor``."""

    def __init__(self, histories: Sequence[History], spec: Spec, config: SACConfig) -> None:
        import torch

        from icrl_dist.algos.stacked import Shape, outputs

        shape = Shape((spec.observation, *config.hidden, 2 * spec.actions))
        actors = torch.from_numpy(np.stack([history.actor for history in histories]))
        self._outputs: Callable[[Any], Any] = lambda seen: outputs(shape, actors, torch.from_numpy(seen[:, None].copy()))
        self._actions = spec.actions

    def act(self, observation: Float32[np.ndarray, "B S"], u: np.ndarray) -> Float32[np.ndarray, "B A"]:
        """The mean action of each expert."""
        mean: np.ndarray = self._outputs(observation)[:, 0, : self._actions].tanh().numpy()
        return mean

    def observe(self, *transition: object) -> None:
        """Nothing to learn."""


class ScriptedPolicy:
    """Meta-World's scripted policy, which is told the true states of the environment that it meets."""

    def meet(self, env: Any) -> None:
        """Before the first ``act``."""
        self._env = env

    def act(self, observation: Float32[np.ndarray, "B S"], u: np.ndarray) -> Float32[np.ndarray, "B A"]:
        """What it does in the true state, whatever is shown."""
        return scripted(self._env.truth)

    def observe(self, *transition: object) -> None:
        """Nothing to learn."""
