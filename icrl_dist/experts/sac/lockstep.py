"""One update of soft actor-critic, for some experts at once: a pure function of parameters, batch and noise."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from icrl_dist.config.sac import SACConfig
from icrl_dist.experts.sac.replay import Transitions
from icrl_dist.experts.sac.stacked import ALIGNED, Buffers, Perceptrons, Shape
from icrl_dist.training.optimizers import Adam

TRAINED = ("actor", "critic", "log_temperature")
"""What Adam trains."""
MOMENTS = ("exp_avg", "exp_avg_sq")
"""Adam's averages of gradients and of their squares, by torch's names."""

_SLACK = 1e-6  # stable-baselines3's: keeps the logarithm of 1 - a^2 finite
_LEAST, _MOST = -20.0, 2.0  # of the logarithm of the standard deviation, as in stable-baselines3


class Drawn(NamedTuple):
    """Actions a = tanh(u), u = mean + deviation * noise, and what their derivatives need."""

    actions: Float[Tensor, "G R A"]
    log_likelihood: Float[Tensor, "G R"]
    inner: Float[Tensor, "G R A"]
    """da/du = 1 - a^2."""
    scaled: Float[Tensor, "G R A"]
    """du / d log deviation, or 0 where that is clamped."""
    free: Float[Tensor, "G R A"]
    """1 where the log deviation is not clamped, else 0."""


def draw(output: Float[Tensor, "G R O"], noise: Float[Tensor, "G R A"]) -> Drawn:
    """The squashed Gaussian of the actor's outputs, at the noise given."""
    mean, raw = output.chunk(2, dim=2)
    log_deviation = raw.clamp(_LEAST, _MOST)
    free = (raw == log_deviation).to(raw.dtype)
    scaled = log_deviation.exp() * noise
    actions = (mean + scaled).tanh()
    inner = 1 - actions * actions
    logs = 0.5 * noise * noise + log_deviation + (inner + _SLACK).log()
    log_likelihood = -logs.sum(2) - 0.5 * math.log(2 * math.pi) * mean.shape[2]
    return Drawn(actions, log_likelihood, inner, scaled * free, free)


def apart(numbers: Float[Tensor, " G"]) -> Float[Tensor, " G"]:
    """The numbers in cache lines of their own.

    Fused Adam rounds what is left over after whole vectors otherwise: which of G numbers in a row that
    is depends on G.
    """
    lines = torch.zeros(len(numbers), ALIGNED, device=numbers.device)
    lines[:, 0] = numbers
    return lines[:, 0]


def _lines(numbers: Float[Tensor, " G"]) -> Float[Tensor, "G L"]:
    """The cache lines of numbers that are ``apart``; what else is in them is 0 and stays 0."""
    return numbers.as_strided((len(numbers), ALIGNED), (ALIGNED, 1))


class Lockstep:
    """G experts that are updated together; their parameters and moments stay where they are."""

    def __init__(
        self, arrays: Mapping[str, Tensor], actor: Shape, critic: Shape, config: SACConfig, dtype: torch.dtype
    ) -> None:
        """``arrays`` are those of ``SACBatch.arrays``, of G experts, and are changed in place; temperatures lie ``apart``."""
        experts, device = len(arrays["actor"]), arrays["actor"].device
        self._config, self._arrays = config, arrays
        both = {name: arrays[name].view(2 * experts, -1) for name in ("critic", "target")}
        self._actor = Perceptrons(actor, arrays["actor"], dtype)
        self._critic = Perceptrons(critic, both["critic"], dtype)
        self._target = Perceptrons(critic, both["target"], dtype)
        self._log_temperature = arrays["log_temperature"]
        temperature_lines = _lines(self._log_temperature)
        self._temperature_gradient = torch.zeros_like(temperature_lines)
        self._actor_buffers = Buffers(actor, experts, 2 * config.batch, dtype, device)
        self._critic_buffers = Buffers(critic, 2 * experts, config.batch, dtype, device)
        self._output_gradient = torch.empty(experts, config.batch, actor.sizes[-1], device=device)
        self._counts: list[Tensor] = []
        self._actor_adam = self._adam(
            ("actor", self._actor.flat, self._actor.gradient, config.actor_rate),
            ("log_temperature", temperature_lines, self._temperature_gradient, config.temperature_rate),
        )
        self._critic_adam = self._adam(("critic", self._critic.flat, self._critic.gradient, config.critic_rate))

    def _adam(self, *parts: tuple[str, Tensor, Tensor, float]) -> Adam:
        """Fused Adam of parameters (name, numbers, gradient, learning rate), on the moments that the arrays hold."""
        groups = [{"params": [numbers], "lr": rate} for _, numbers, _, rate in parts]
        made = Adam(groups, fused=True, capturable=parts[0][1].is_cuda)
        for name, numbers, gradient, _ in parts:
            numbers.grad = gradient
            self._counts.append(torch.zeros((), device=numbers.device))
            moments = {moment: self._arrays[f"{name}/{moment}"] for moment in MOMENTS}
            moments = {m: _lines(own) if own.dim() == 1 else own.view_as(numbers) for m, own in moments.items()}
            made.state[numbers] = {"step": self._counts[-1], **moments}
        return made

    def changed(self) -> list[Tensor]:
        """All that one update hands on to the next."""
        copies = [copy for part in (self._actor, self._critic, self._target) for copy in part.copies()]
        return [*self._arrays.values(), *self._counts, *copies]

    def refresh(self, updates: int) -> None:
        """Take up parameters and moments that somebody else has changed, after so many updates."""
        for count in self._counts:
            count.fill_(updates)
        for part in (self._actor, self._critic, self._target):
            part.refresh()

    @torch.no_grad()
    def update(self, batch: Transitions, noise: Float[Tensor, "2 G B A"]) -> None:
        """Temperature, critics, actor and target critics, each once, as ``stable_baselines3.SAC.train`` does."""
        experts, count, seen = batch.observations.shape
        temperature = self._log_temperature.exp()

        self._actor_buffers.input[:, :count] = batch.observations
        self._actor_buffers.input[:, count:] = batch.following
        both = draw(self._actor.forward(self._actor_buffers), torch.cat([noise[0], noise[1]], dim=1))
        now = Drawn(*(part[:, :count] for part in both))

        reward_to_come = self._values(self._target, batch.following, both.actions[:, count:]).amin(1)
        reward_to_come -= temperature.unsqueeze(1) * both.log_likelihood[:, count:]
        wanted = batch.rewards + self._config.gamma * reward_to_come

        error = self._values(self._critic, batch.observations, batch.actions) - wanted.unsqueeze(1)
        self._critic.backward(self._critic_buffers, (error / count).view(2 * experts, count, 1))
        self._critic_adam.step()
        self._critic.refresh()

        values = self._values(self._critic, batch.observations, now.actions)
        by_values = torch.zeros_like(values).scatter_(1, values.argmin(1, keepdim=True), -1 / count)
        by_input = self._critic.input_gradient(self._critic_buffers, by_values.view(2 * experts, count, 1), seen)
        by_action = by_input.view(experts, 2, count, -1).sum(1)
        self._descend_actor(now, by_action, temperature)
        self._target.flat.lerp_(self._critic.flat, self._config.tau)
        self._target.refresh()

    def _descend_actor(self, now: Drawn, by_action: Float[Tensor, "G B A"], temperature: Float[Tensor, " G"]) -> None:
        """Down the mean of temperature * log likelihood - smaller value; the temperature towards entropy -A."""
        count, actions = now.actions.shape[1:]
        weight = (temperature / count).view(-1, 1, 1)
        by_u = now.inner * (by_action + weight * 2 * now.actions / (now.inner + _SLACK))
        mean, deviation = self._output_gradient.chunk(2, dim=2)
        mean.copy_(by_u)
        torch.sub(by_u * now.scaled, weight * now.free, out=deviation)
        self._actor.backward(self._actor_buffers, self._output_gradient)
        torch.neg(now.log_likelihood.mean(1) - actions, out=self._temperature_gradient[:, 0])
        self._actor_adam.step()
        self._actor.refresh()

    def _values(
        self, critics: Perceptrons, observations: Float[Tensor, "G B S"], actions: Float[Tensor, "G B A"]
    ) -> Float[Tensor, "G 2 B"]:
        """What both critics of each expert give."""
        experts, count, seen = observations.shape
        read = self._critic_buffers.input.view(experts, 2, count, -1)
        read[..., :seen] = observations.unsqueeze(1)
        read[..., seen:] = actions.unsqueeze(1)
        return critics.forward(self._critic_buffers).view(experts, 2, count)
