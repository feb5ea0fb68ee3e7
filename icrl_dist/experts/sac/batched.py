"""Soft actor-critic for N experts of one shape in lockstep: one product a layer for all of them.

The mathematics, step for step, is that of ``stable_baselines3.SAC.train``; tests hold both together
from the same weights, batches and noise.  Each expert has its own losses (their sum is descended,
never their mean) and its own chance, so an expert becomes the same in any company; on a CPU to the bit,
if batches are of a multiple of 16 transitions.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Literal

import numpy as np
import torch
from jaxtyping import Float, Float32, Int
from torch import Tensor

from icrl_dist.config.sac import SACConfig
from icrl_dist.experts.sac import draws, sb3_files
from icrl_dist.experts.sac.draws import Chance
from icrl_dist.experts.sac.graphed import Graphed
from icrl_dist.experts.sac.lockstep import MOMENTS, TRAINED, Lockstep, apart
from icrl_dist.experts.sac.reference import Reference
from icrl_dist.experts.sac.replay import Replay, Transitions
from icrl_dist.experts.sac.stacked import Shape, outputs
from icrl_dist.interfaces import Batch
from icrl_dist.types import Spec, Step

Products = Literal["float32", "bfloat16"]
By = Literal["lockstep", "stable-baselines3"]
"""What makes the updates."""


def pick(device: str) -> torch.device:
    """``auto``: a GPU if there is one.  Raises ValueError for a GPU where there is none."""
    if device == "auto":
        return torch.device("cuda" if torch.cuda.is_available() else "cpu")
    if device.startswith("cuda") and not torch.cuda.is_available():
        raise ValueError(f"device = {device!r}: torch finds no GPU here: choose 'auto' or 'cpu'")
    return torch.device(device)


class SACBatch:
    """N experts: parameters, Adam's moments, temperatures, and what each remembers."""

    def __init__(
        self,
        seeds: Sequence[int],
        spec: Spec,
        config: SACConfig,
        device: str = "auto",
        products: Products = "float32",
        capacity: int | None = None,
        graph: bool = True,
        by: By = "lockstep",
    ) -> None:
        """An expert for each seed, which draws its first parameters; ``products`` are of float32 or
        bfloat16 numbers, parameters and Adam of float32; ``capacity`` of the replay is ``config.replay``
        if not given; on a GPU an update is a CUDA graph, unless ``graph`` is false.  ``by``
        stable-baselines3 is one expert's, float32 on the CPU.  Raises ValueError for discrete
        actions, no expert, or what stable-baselines3 has not.
        """
        experts = len(seeds)
        if spec.discrete or experts < 1:
            raise ValueError(f"SAC: {experts} experts, discrete = {spec.discrete}: at least 1, and actions in [-1, 1]^A")
        self.experts, self.spec, self.config, self.device = experts, spec, config, pick(device)
        self.steps = 0
        """Environment steps that ``train`` has made in each expert's environment."""
        self.updates = 0
        S, A = spec.observation, spec.actions
        self.actor_shape = Shape((S, *config.hidden, 2 * A))
        self.critic_shape = Shape((S + A, *config.hidden, 1))
        generators = [draws.generator(seed, draws.FIRST) for seed in seeds]
        critic = torch.stack([self.critic_shape.draw(2, own) for own in generators])
        first = {
            "actor": torch.cat([self.actor_shape.draw(1, own) for own in generators]),
            "critic": critic,
            "target": critic.clone(),
            "log_temperature": torch.full((experts,), config.temperature).log(),
        }
        first |= {f"{name}/{moment}": torch.zeros_like(first[name]) for name in TRAINED for moment in MOMENTS}
        placed = {name: array.to(self.device) for name, array in first.items()}
        self.arrays: dict[str, Tensor] = {name: apart(one) if one.dim() == 1 else one for name, one in placed.items()}
        """By name, the expert first: ``actor``, ``critic`` (the two of an expert), ``target``,
        ``log_temperature``, and Adam's moments as ``actor/exp_avg`` and so on."""
        self._updater = updater = self._made_by(by, products)

        def step(*given: Tensor) -> None:
            updater.update(Transitions(*given[:-1]), given[-1])

        self._step: Callable[..., None] = step
        if graph and isinstance(updater, Lockstep) and self.device.type == "cuda":
            self._step = Graphed(step, updater.changed())
        self.replay = Replay(experts, config.replay if capacity is None else capacity, S, A, self.device)

    def _made_by(self, by: By, products: Products) -> Lockstep | Reference:
        shapes = self.actor_shape, self.critic_shape
        if by == "lockstep":
            return Lockstep(self.arrays, *shapes, self.config, getattr(torch, products))
        if (self.experts, products, self.device.type) == (1, "float32", "cpu"):
            return Reference(self.arrays, shapes, self.spec, self.config)
        what = f"{self.experts} experts, {products} products, {self.device}"
        raise ValueError(f"stable-baselines3: {what}: it has one expert, float32, here on the CPU; take lockstep")

    @torch.no_grad()
    def act(
        self, observations: Float[np.ndarray, "N *E S"], normal: Float32[np.ndarray, "N *E A"] | None = None
    ) -> Float32[np.ndarray, "N *E A"]:
        """Actions in [-1, 1] of each expert in its environment, or in its E environments: the mean squashed.

        With standard ``normal`` noise an action that is drawn.
        """
        flat = np.array(observations, np.float32).reshape(self.experts, -1, self.spec.observation)
        given = torch.from_numpy(flat).to(self.device)
        mean, spread = outputs(self.actor_shape, self.arrays["actor"], given).chunk(2, dim=2)
        if normal is not None:
            noise = torch.from_numpy(normal.reshape(mean.shape)).to(self.device)
            mean = mean + noise * spread.clamp(-20.0, 2.0).exp()
        chosen: np.ndarray = mean.tanh().cpu().numpy()
        return chosen.reshape(*np.shape(observations)[:-1], self.spec.actions)

    def update(self, batch: Transitions, noise: Float[Tensor, "2 N B A"]) -> None:
        """One update of every expert by ``config.batch`` transitions of its own.

        ``noise`` is standard normal: the actions' at the observations, then at the following ones.
        """
        self._step(*batch, noise)
        self.updates += 1

    def remember(self, observations: Float32[np.ndarray, "N S"], actions: Float32[np.ndarray, "N A"], step: Step) -> None:
        """One step of every expert's environment, for its replay; a simulation that has broken down teaches nothing."""
        columns = (observations, actions, step.reward, step.observation, *(() if step.diverged is None else (step.diverged,)))
        self.replay.add(*(torch.from_numpy(np.array(column)) for column in columns))
        self.steps += 1

    def learn(self, picks: Int[Tensor, "N B"], noise: Float[Tensor, "2 N B A"]) -> None:
        """One update from the replay: by the transitions with these numbers."""
        self.update(self.replay.take(picks), noise)

    def state(self) -> dict[str, np.ndarray]:
        """Everything that further training depends on, as plain arrays."""
        own = {name: array.cpu().numpy().copy() for name, array in self.arrays.items()}
        counts = {"steps": np.array(self.steps), "updates": np.array(self.updates)}
        return own | counts | {f"replay/{name}": array for name, array in self.replay.state().items()}

    def load(self, state: Mapping[str, np.ndarray]) -> None:
        """The inverse of ``state``.  Raises ValueError if it is another shape's."""
        self.replay.load({name: state[f"replay/{name}"] for name in ("rows", "added")})
        self._take({name: torch.from_numpy(np.array(state[name])) for name in self.arrays}, int(state["updates"]))
        self.steps = int(state["steps"])

    def save_sb3(self, index: int, path: Path) -> None:
        """Expert ``index`` as a file that ``stable_baselines3.SAC.load`` opens and can train on."""
        one = {name: array[index].cpu() for name, array in self.arrays.items()}
        sb3_files.save(path, self.spec, self.config, (self.actor_shape, self.critic_shape), one, self.updates)

    def load_sb3(self, paths: Sequence[Path]) -> None:
        """Take expert i's parameters and moments from file i; the replays stay as they are.

        Raises ValueError unless there is a file for each expert, all of this shape and with the
        same number of updates.
        """
        if len(paths) != self.experts:
            raise ValueError(f"{len(paths)} files for {self.experts} experts: give one for each")
        shapes = (self.actor_shape, self.critic_shape)
        found = [sb3_files.load(path, self.spec, self.config, shapes) for path in paths]
        updates = sorted({count for _, count in found})
        if len(updates) != 1:
            raise ValueError(f"experts after {updates} updates cannot go on in lockstep: load those of one length together")
        self._take({name: torch.stack([one[name] for one, _ in found]) for name in self.arrays}, updates[0])

    def _take(self, arrays: Mapping[str, Tensor], updates: int) -> None:
        for name, array in self.arrays.items():
            if arrays[name].shape != array.shape:
                raise ValueError(
                    f"{name} has the shape {tuple(arrays[name].shape)}, not {tuple(array.shape)}: "
                    "load it into as many experts, of the same spec and hidden layers"
                )
        for name, array in self.arrays.items():
            array.copy_(arrays[name])
        self.updates = updates
        self._updater.refresh(updates)


def train(
    env: Batch,
    config: SACConfig,
    steps: int,
    seeds: Sequence[int],
    progress: Callable[[SACBatch, Float[np.ndarray, " N"]], None] = lambda experts, returns: None,
    device: str = "auto",
    products: Products = "float32",
    state: Mapping[str, np.ndarray] | None = None,
    by: By = "lockstep",
) -> SACBatch:
    """An expert for each of the N environments of ``env``, after ``steps`` steps in it.

    ``progress`` hears the experts and their returns after every episode.  All draws are keyed by an
    expert's seed and the episode: from a ``state`` that was taken in ``progress`` training goes on as if
    it had never stopped.  On a CPU give torch one thread: two are slower.  Raises ValueError for another
    number of seeds and for a state within an episode, FloatingPointError if an expert's weights stop being
    numbers.
    """
    horizon = env.spec.horizon
    if len(seeds) != env.batch:
        raise ValueError(f"{len(seeds)} seeds for {env.batch} environments: give one for each")
    experts = SACBatch(seeds, env.spec, config, device, products, min(config.replay, steps), by=by)
    if state is not None:
        experts.load(state)

    def learns(step: int) -> bool:
        return step > config.warmup and step % config.update_every == 0

    if experts.steps % horizon:
        raise ValueError(f"the state is of step {experts.steps}, within an episode of {horizon}: take it in `progress`")
    while experts.steps < steps:
        first, total = experts.steps, np.zeros(experts.experts)
        last = min(first + horizon, steps)
        count = sum(map(learns, range(first + 1, last + 1)))
        drawn = Chance(seeds, first // horizon, env.spec, config, count, experts.device)
        updates = iter(drawn.updates)
        seen = np.asarray(env.reset(drawn.starts), np.float32)
        for number in range(last - first):
            if experts.steps < config.random_steps:
                action = drawn.uniform[number].astype(np.float32)
            else:
                action = experts.act(seen, drawn.normal[number])
                _need_numbers(action, experts.steps)
            step = env.step(action)
            experts.remember(seen, action, step)
            if learns(experts.steps):
                experts.learn(*next(updates))
            seen, total = step.observation, total + step.reward
        _need_numbers(experts.arrays["actor"].cpu().numpy(), experts.steps)
        progress(experts, total)
    return experts


def _need_numbers(of: Float32[np.ndarray, "N *_"], steps: int) -> None:
    lost = [number for number, own in enumerate(of) if not np.isfinite(own).all()]
    if lost:
        raise FloatingPointError(f"weights of experts {lost} are not numbers at step {steps}: lower the learning rates")
