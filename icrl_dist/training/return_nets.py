"""ARDT's return nets: the returns of the best actions under the worst disturbance, from logged episodes.

Two networks of the task, the step, the state s and the action a.  The second also reads the adversary's action b::

    Q2(h, s, a, b)   upper expectile (1 - alpha) of r + Q1(h + 1, s', a') over what followed; r at the last step
    Q1(h, s, a)      lower expectile (alpha) of Q2(h, s, a, b) over the adversary's actions in the data

So Q1 is the return-to-go that is left if the adversary chooses the worst of its logged actions and the agent the best of
its own.  The first half of the steps fits both to observed returns-to-go, from which the recursion then begins.
"""

from __future__ import annotations

import contextlib
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Float32, Int64
from torch import Tensor, nn

from icrl_dist.config.random_keys import RandomKey, generator
from icrl_dist.models.features import Features
from icrl_dist.training import optimizers
from icrl_dist.training.sequences import Histories
from icrl_dist.types import Spec


@dataclass(frozen=True)
class Settings:
    """How the nets are fitted; see ``methods.ardt.ARDTConfig``."""

    alpha: float
    leaf_weight: float
    steps: int
    batch: int
    width: int
    learning_rate: float


def expectile_loss(error: Float[Tensor, "*N"], alpha: float) -> Float[Tensor, ""]:
    """The mean of w * error^2, where ``error`` is target - prediction and w is ``alpha`` above 0, else 1 - ``alpha``.

    Its minimizer is the alpha-expectile of the targets: near the smallest for alpha near 0, near the largest for alpha
    near 1, the mean for 0.5.
    """
    weight = torch.where(error > 0, alpha, 1 - alpha)
    return (weight * error**2).mean()


def minimax_loss(
    q1: Float[Tensor, "N H"], q2: Float[Tensor, "N H"], rewards: Float[Tensor, "N H"], alpha: float, leaf_weight: float
) -> Float[Tensor, ""]:
    """The loss of both nets on N episodes: the recursion (tree) and the last step (leaf) of Q2, and the expectile of Q1."""
    tree = expectile_loss(rewards[:, :-1] + q1.detach()[:, 1:] - q2[:, :-1], 1 - alpha) if q1.shape[1] > 1 else q2.new_zeros(())
    leaf = ((rewards[:, -1] - q2[:, -1]) ** 2).mean()
    return (1 - leaf_weight) * tree + leaf_weight * leaf + expectile_loss(q2.detach() - q1, alpha)


class ReturnNet(nn.Module):
    """One of the two networks."""

    def __init__(self, tasks: int, inputs: int, width: int) -> None:
        super().__init__()
        self.task = nn.Embedding(tasks, width)
        self.embed = nn.Linear(inputs, width)
        self.rest = nn.Sequential(nn.GELU(), nn.Linear(width, width), nn.GELU(), nn.Linear(width, 1))

    def forward(self, tasks: Tensor, inputs: Float[Tensor, "N H I"]) -> Float[Tensor, "N H"]:
        found: Tensor = self.rest(self.task(tasks) + self.embed(inputs)).squeeze(-1)
        return found


class ReturnNets:
    """Both nets, computed by one thread on the CPU; the same histories and seed give the same nets."""

    def __init__(self, spec: Spec, fourier: int, settings: Settings, tasks: int, seed: int) -> None:
        """``tasks``: number of training tasks."""
        self._spec, self._features, self._settings, self._seed = spec, Features(spec, fourier), settings, seed
        self._tasks, self._scale, self._strongest = tasks, 1.0, 1.0

    def fit(self, histories: Sequence[Histories], tasks: Sequence[int]) -> None:
        """Fit to the histories of every variation, given the numbers of their tasks.

        Raises FloatingPointError if the loss becomes infinite or not a number.
        """
        self._scale = max(1e-6, *(float(abs(one.observed).max()) for one in histories))
        if not self._spec.discrete:
            self._strongest = max(1e-6, *(float(abs(one.adversary).max()) for one in histories))
        inputs = self._inputs(histories[0], slice(0, 1))
        sizes = inputs[0].shape[-1], sum(part.shape[-1] for part in inputs)
        rng = generator(self._seed, RandomKey.RETURN_NETS, 0)
        with torch.random.fork_rng(()):  # torch's generator is that of the model
            self._q1, self._q2 = (_initialized(ReturnNet(self._tasks, size, self._settings.width), rng) for size in sizes)
        with _one_thread():
            self._take_steps(histories, np.asarray(tasks))

    def _take_steps(self, histories: Sequence[Histories], tasks: Int64[np.ndarray, " V"]) -> None:
        of = self._settings
        optimizer = optimizers.Adam([*self._q1.parameters(), *self._q2.parameters()], lr=of.learning_rate)
        for step in range(of.steps):
            number, agent, adversary, rewards, observed = self._drawn(histories, tasks, step)
            q1, q2 = self._q1(number, agent), self._q2(number, torch.cat([agent, adversary], dim=-1))
            if step < of.steps // 2:
                loss = ((q1 - observed) ** 2).mean() + ((q2 - observed) ** 2).mean()
            else:
                loss = minimax_loss(q1, q2, rewards, of.alpha, of.leaf_weight)
            loss.backward()
            optimizer.step()
            optimizer.zero_grad()
            if not math.isfinite(value := loss.item()):
                rate = of.learning_rate
                raise FloatingPointError(
                    f"the loss of the return nets is {value} at step {step}: lower ardt.learning_rate ({rate})"
                )

    def _drawn(self, histories: Sequence[Histories], tasks: Int64[np.ndarray, " V"], step: int) -> list[Tensor]:
        """Tasks, inputs of both kinds, rewards and observed returns-to-go of the episodes of a step; returns are scaled."""
        rng = generator(self._seed, RandomKey.RETURN_NETS, 1, step)
        rows = []
        for number in rng.integers(0, len(histories), size=self._settings.batch):
            one = histories[int(number)]
            episode = int(rng.integers(0, len(one.rewards)))
            agent, adversary = self._inputs(one, slice(episode, episode + 1))
            task = np.full(one.rewards.shape[1], tasks[number])
            scaled = (of[episode] / np.float32(self._scale) for of in (one.rewards, one.observed))
            rows.append((task, agent[0], adversary[0], *scaled))
        return [torch.from_numpy(np.stack(column)) for column in zip(*rows, strict=True)]

    @torch.inference_mode()
    def relabelled(self, task: int, history: Histories) -> Float32[np.ndarray, "E H"]:
        """Q1 at every step of the episodes of one variation of this task, by one thread, so that each call gives the same."""
        agent, _ = self._inputs(history, slice(None))
        with _one_thread():
            found: np.ndarray = self._q1(torch.full(history.rewards.shape, task), torch.from_numpy(agent)).numpy()
        return found * np.float32(self._scale)

    def _inputs(self, of: Histories, rows: slice) -> tuple[Float32[np.ndarray, "N H I"], Float32[np.ndarray, "N H B"]]:
        """Step, state and action of these episodes, and the adversary's action."""
        actions, adversary = of.actions[rows], of.adversary[rows]
        step = np.broadcast_to(np.linspace(0, 1, actions.shape[1], dtype=np.float32)[:, None], (*actions.shape[:2], 1))
        states = self._features.observations(of.observations[rows, :-1])
        agent = np.concatenate([step, states, self._features.actions(actions)], axis=-1, dtype=np.float32)
        if self._spec.discrete:  # -1, no override, is an action of its own
            return agent, np.eye(self._spec.actions + 1, dtype=np.float32)[adversary + 1]
        return agent, (adversary / np.float32(self._strongest)).astype(np.float32)


@contextlib.contextmanager
def _one_thread() -> Iterator[None]:
    """Torch computes with one thread, so results do not depend on the threads of the process."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(threads)


def _initialized(net: ReturnNet, rng: np.random.Generator) -> ReturnNet:
    """The net with initial weights drawn by this generator."""
    with torch.no_grad():
        for name, parameter in net.named_parameters():
            scale = 0.0 if name.endswith("bias") else 0.3 if name.startswith("task") else parameter.shape[1] ** -0.5
            parameter.copy_(torch.from_numpy((scale * rng.standard_normal(parameter.shape)).astype(np.float32)))
    return net
