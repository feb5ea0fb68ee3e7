"""Soft actor-critic for N experts of one shape in lockstep: one matrix product per layer for all of them.

The mathematics is that of ``stable_baselines3.SAC.train``, step by step; tests compare both from the
same weights, batches and noise.  Each expert has its own losses (the sum over experts is minimized,
not the mean) and its own random generators, so its training does not depend on the other experts; on a
CPU this holds to the bit, if the batch is a multiple of 16 transitions.
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
from icrl_dist.experts.sac.cuda_graph import GraphedCallable
from icrl_dist.experts.sac.draws import EpisodeDraws
from icrl_dist.experts.sac.lockstep import MOMENTS, TRAINED, GivenTemperature, Lockstep, in_own_cache_lines
from icrl_dist.experts.sac.replay import Replay, ReplayBatch
from icrl_dist.experts.sac.sb3_updater import SB3Updater
from icrl_dist.experts.sac.stacked import Shape, outputs
from icrl_dist.interfaces import Batch
from icrl_dist.types import Spec, Step

MatmulDtype = Literal["float32", "bfloat16"]
Backend = Literal["lockstep", "stable-baselines3"]
"""The implementation of an update."""


def pick(device: str) -> torch.device:
    """The torch device; ``auto`` is a GPU if there is one.  Raises ValueError for ``cuda`` without a GPU."""
    if device == "auto":
        return torch.device("cuda" if torch.cuda.is_available() else "cpu")
    if device.startswith("cuda") and not torch.cuda.is_available():
        raise ValueError(f"device = {device!r}: torch finds no GPU here; choose 'auto' or 'cpu'")
    return torch.device(device)


class SACBatch:
    """N experts: parameters, Adam's moments, temperatures, and one replay each."""

    def __init__(
        self,
        seeds: Sequence[int],
        spec: Spec,
        config: SACConfig,
        device: str = "auto",
        matmul_dtype: MatmulDtype = "float32",
        capacity: int | None = None,
        graph: bool = True,
        backend: Backend = "lockstep",
        given_temperature: bool = False,
    ) -> None:
        """One expert per seed; the seed draws its initial parameters.

        ``matmul_dtype`` is the precision of matrix products; parameters and Adam are always float32.
        ``capacity`` of the replay defaults to ``config.replay``.  On a GPU an update is a CUDA graph,
        unless ``graph`` is false.  The backend stable-baselines3 supports one expert in float32 on the
        CPU.  ``given_temperature``: see ``GivenTemperature``; only lockstep has it.
        Raises ValueError for discrete actions, for no expert, and for what the backend does not support.
        """
        experts = len(seeds)
        if spec.discrete or experts < 1:
            raise ValueError(f"SAC: {experts} experts, discrete = {spec.discrete}: at least 1, and actions in [-1, 1]^A")
        self.experts, self.spec, self.config, self.device = experts, spec, config, pick(device)
        self.steps = 0
        """Environment steps of each expert so far."""
        self.updates = 0
        """Updates of each expert so far."""
        S, A = spec.observation, spec.actions
        self.actor_shape = Shape((S, *config.hidden, 2 * A))
        self.critic_shape = Shape((S + A, *config.hidden, 1))
        generators = [draws.generator(seed, draws.INITIALIZATION) for seed in seeds]
        critic = torch.stack([self.critic_shape.draw(2, own) for own in generators])
        initial = {
            "actor": torch.cat([self.actor_shape.draw(1, own) for own in generators]),
            "critic": critic,
            "target": critic.clone(),
            "log_temperature": torch.full((experts,), config.temperature).log(),
        }
        initial |= {f"{name}/{moment}": torch.zeros_like(initial[name]) for name in TRAINED for moment in MOMENTS}
        placed = {name: array.to(self.device) for name, array in initial.items()}
        self.arrays: dict[str, Tensor] = {
            name: in_own_cache_lines(array) if array.dim() == 1 else array for name, array in placed.items()
        }
        """By name, with the expert as first axis: ``actor``, ``critic`` (two per expert), ``target``,
        ``log_temperature``, and Adam's moments as ``actor/exp_avg`` and so on."""
        self._updater = updater = self._make_updater(backend, matmul_dtype, given_temperature)

        def step(*inputs: Tensor) -> None:
            updater.update(ReplayBatch(*inputs[:-1]), inputs[-1])

        self._step: Callable[..., None] = step
        if graph and isinstance(updater, Lockstep) and self.device.type == "cuda":
            self._step = GraphedCallable(step, updater.changed())
        self.replay = Replay(experts, config.replay if capacity is None else capacity, S, A, self.device)

    def _make_updater(self, backend: Backend, matmul_dtype: MatmulDtype, given_temperature: bool) -> Lockstep | SB3Updater:
        shapes = self.actor_shape, self.critic_shape
        if backend == "lockstep":
            lockstep = GivenTemperature if given_temperature else Lockstep
            return lockstep(self.arrays, *shapes, self.config, getattr(torch, matmul_dtype))
        if (self.experts, matmul_dtype, self.device.type) == (1, "float32", "cpu"):
            return SB3Updater(self.arrays, shapes, self.spec, self.config)
        found = f"{self.experts} experts, {matmul_dtype} products, {self.device}"
        raise ValueError(f"stable-baselines3: {found}: it supports one expert in float32 on the CPU; use lockstep")

    @torch.no_grad()
    def act(
        self, observations: Float[np.ndarray, "N *E S"], normal: Float32[np.ndarray, "N *E A"] | None = None
    ) -> Float32[np.ndarray, "N *E A"]:
        """Actions in [-1, 1] of each expert, in one or E environments: the squashed mean, or a sample.

        A sample is drawn with the standard ``normal`` noise, if given.
        """
        flat = np.array(observations, np.float32).reshape(self.experts, -1, self.spec.observation)
        inputs = torch.from_numpy(flat).to(self.device)
        mean, log_deviation = outputs(self.actor_shape, self.arrays["actor"], inputs).chunk(2, dim=2)
        if normal is not None:
            noise = torch.from_numpy(normal.reshape(mean.shape)).to(self.device)
            mean = mean + noise * log_deviation.clamp(-20.0, 2.0).exp()
        actions: np.ndarray = mean.tanh().cpu().numpy()
        return actions.reshape(*np.shape(observations)[:-1], self.spec.actions)

    def update(self, batch: ReplayBatch, noise: Float[Tensor, "2 N B A"]) -> None:
        """One update of every expert, each with its own ``config.batch`` transitions.

        ``noise`` is standard normal: of the actions at the observations, then at the next observations.
        """
        self._step(*batch, noise)
        self.updates += 1

    def store(self, observations: Float32[np.ndarray, "N S"], actions: Float32[np.ndarray, "N A"], step: Step) -> None:
        """Store one step of every expert's environment in its replay; steps of a diverged simulation are left out."""
        columns = (observations, actions, step.reward, step.observation, *(() if step.diverged is None else (step.diverged,)))
        self.replay.add(*(torch.from_numpy(np.array(column)) for column in columns))
        self.steps += 1

    def update_from_replay(self, picks: Int[Tensor, "N B"], noise: Float[Tensor, "2 N B A"]) -> None:
        """One update with the transitions of the replay that have these numbers."""
        self.update(self.replay.take(picks), noise)

    def state(self) -> dict[str, np.ndarray]:
        """Everything that further training depends on, as numpy arrays."""
        arrays = {name: array.cpu().numpy().copy() for name, array in self.arrays.items()}
        counts = {"steps": np.array(self.steps), "updates": np.array(self.updates)}
        return arrays | counts | {f"replay/{name}": array for name, array in self.replay.state().items()}

    def load(self, state: Mapping[str, np.ndarray]) -> None:
        """The inverse of ``state``.  Raises ValueError if shapes differ."""
        self.replay.load({name: state[f"replay/{name}"] for name in ("rows", "added")})
        self._set_arrays({name: torch.from_numpy(np.array(state[name])) for name in self.arrays}, int(state["updates"]))
        self.steps = int(state["steps"])

    def save_sb3(self, index: int, path: Path) -> None:
        """Write expert ``index`` to a file that ``stable_baselines3.SAC.load`` opens and can continue to train."""
        expert = {name: array[index].cpu() for name, array in self.arrays.items()}
        sb3_files.save(path, self.spec, self.config, (self.actor_shape, self.critic_shape), expert, self.updates)

    def load_sb3(self, paths: Sequence[Path]) -> None:
        """Load expert i's parameters and moments from file i; the replays do not change.  Executes nothing of the files.

        Raises ValueError unless there is one file per expert, all of this shape and with the same
        number of updates.
        """
        if len(paths) != self.experts:
            raise ValueError(f"{len(paths)} files for {self.experts} experts: give one per expert")
        shapes = (self.actor_shape, self.critic_shape)
        found = [sb3_files.load(path, self.spec, self.config, shapes) for path in paths]
        updates = sorted({count for _, count in found})
        if len(updates) != 1:
            raise ValueError(
                f"experts after {updates} updates cannot continue in lockstep: load only experts with equal numbers of updates"
            )
        self._set_arrays({name: torch.stack([expert[name] for expert, _ in found]) for name in self.arrays}, updates[0])

    def _set_arrays(self, arrays: Mapping[str, Tensor], updates: int) -> None:
        for name, array in self.arrays.items():
            if arrays[name].shape != array.shape:
                raise ValueError(
                    f"{name} has the shape {tuple(arrays[name].shape)}, not {tuple(array.shape)}: "
                    "load it into the same number of experts, of the same spec and hidden layers"
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
    matmul_dtype: MatmulDtype = "float32",
    state: Mapping[str, np.ndarray] | None = None,
    backend: Backend = "lockstep",
) -> SACBatch:
    """Train one expert in each of the N environments of ``env`` for ``steps`` steps, and return them.

    ``progress`` is called after every episode with the experts and their returns.  All draws are keyed
    by an expert's seed and the episode, so training that continues from a ``state`` taken in ``progress``
    gives the same result as training without interruption.  On a CPU set torch to one thread: two are
    slower.  Raises ValueError for another number of seeds and for a state taken within an episode,
    FloatingPointError if an expert's actions or weights become NaN or infinite.
    """
    horizon = env.spec.horizon
    if len(seeds) != env.batch:
        raise ValueError(f"{len(seeds)} seeds for {env.batch} environments: give one per environment")
    experts = SACBatch(seeds, env.spec, config, device, matmul_dtype, min(config.replay, steps), backend=backend)
    if state is not None:
        experts.load(state)

    if experts.steps % horizon:
        raise ValueError(f"the state is of step {experts.steps}, within an episode of {horizon} steps: take it in `progress`")
    while experts.steps < steps:
        first, total = experts.steps, np.zeros(experts.experts)
        last = min(first + horizon, steps)
        count = sum(has_update(config, step) for step in range(first + 1, last + 1))
        episode = EpisodeDraws(seeds, first // horizon, env.spec, config, count, experts.device)
        updates = iter(episode.updates)
        observation = np.asarray(env.reset(episode.starts), np.float32)
        for number in range(last - first):
            if experts.steps < config.random_steps:
                action = episode.uniform[number].astype(np.float32)
            else:
                action = experts.act(observation, episode.normal[number])
                require_finite(action, experts.steps)
            step = env.step(action)
            experts.store(observation, action, step)
            if has_update(config, experts.steps):
                experts.update_from_replay(*next(updates))
            observation, total = step.observation, total + step.reward
        require_finite(experts.arrays["actor"].cpu().numpy(), experts.steps)
        progress(experts, total)
    return experts


def has_update(config: SACConfig, step: int) -> bool:
    """Whether an update follows this step of the training, counted from 1."""
    return step > config.warmup and step % config.update_every == 0


def require_finite(values: Float32[np.ndarray, "N *_"], steps: int) -> None:
    """Raises FloatingPointError, with the experts, for actions or weights of N experts that are NaN or infinite."""
    diverged = [number for number, row in enumerate(values) if not np.isfinite(row).all()]
    if diverged:
        raise FloatingPointError(f"weights of experts {diverged} are NaN or infinite at step {steps}: lower the learning rates")
