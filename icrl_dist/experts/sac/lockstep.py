"""One update of soft actor-critic for several experts at once: a pure function of parameters, batch and noise."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from icrl_dist.config.sac import SACConfig
from icrl_dist.experts.sac.replay import ReplayBatch
from icrl_dist.experts.sac.stacked import ALIGNED, Buffers, Perceptrons, Shape
from icrl_dist.training.optimizers import Adam

TRAINED = ("actor", "critic", "log_temperature")
"""The parameters that Adam trains."""
MOMENTS = ("exp_avg", "exp_avg_sq")
"""Adam's averages of gradients and of squared gradients, by torch's names."""

_EPSILON = 1e-6  # keeps log(1 - a^2) finite; as in stable-baselines3
_LOG_DEVIATION_MIN, _LOG_DEVIATION_MAX = -20.0, 2.0  # as in stable-baselines3


class SquashedSample(NamedTuple):
    """Actions a = tanh(u) with u = mean + deviation * noise, and what their derivatives need."""

    actions: Float[Tensor, "G R A"]
    log_likelihood: Float[Tensor, "G R"]
    da_du: Float[Tensor, "G R A"]
    """1 - a^2."""
    du_dlog: Float[Tensor, "G R A"]
    """Derivative of u by the log deviation; 0 where the log deviation is clamped."""
    unclamped: Float[Tensor, "G R A"]
    """1 where the log deviation is not clamped, else 0."""


def sample(output: Float[Tensor, "G R O"], noise: Float[Tensor, "G R A"]) -> SquashedSample:
    """Actions of the squashed Gaussian given by the actor's outputs, at the given noise."""
    mean, raw = output.chunk(2, dim=2)
    log_deviation = raw.clamp(_LOG_DEVIATION_MIN, _LOG_DEVIATION_MAX)
    unclamped = (raw == log_deviation).to(raw.dtype)
    scaled_noise = log_deviation.exp() * noise
    actions = (mean + scaled_noise).tanh()
    da_du = 1 - actions * actions
    logs = 0.5 * noise * noise + log_deviation + (da_du + _EPSILON).log()
    log_likelihood = -logs.sum(2) - 0.5 * math.log(2 * math.pi) * mean.shape[2]
    return SquashedSample(actions, log_likelihood, da_du, scaled_noise * unclamped, unclamped)


def in_own_cache_lines(values: Float[Tensor, " G"]) -> Float[Tensor, " G"]:
    """Store each value in its own cache line.

    Fused Adam rounds the values after the last whole vector differently, and which of G adjacent values
    these are depends on G.
    """
    lines = torch.zeros(len(values), ALIGNED, device=values.device)
    lines[:, 0] = values
    return lines[:, 0]


def _cache_lines(values: Float[Tensor, " G"]) -> Float[Tensor, "G L"]:
    """The whole cache lines of values made by ``in_own_cache_lines``; the rest of a line is 0 and stays 0."""
    return values.as_strided((len(values), ALIGNED), (ALIGNED, 1))


class Lockstep:
    """Updates G experts together; their parameters and moments are changed in place."""

    def __init__(
        self, arrays: Mapping[str, Tensor], actor: Shape, critic: Shape, config: SACConfig, dtype: torch.dtype
    ) -> None:
        """``arrays``: ``SACBatch.arrays`` of G experts, with temperatures ``in_own_cache_lines``; changed in place."""
        experts, device = len(arrays["actor"]), arrays["actor"].device
        self._config, self._arrays = config, arrays
        both = {name: arrays[name].view(2 * experts, -1) for name in ("critic", "target")}
        self._actor = Perceptrons(actor, arrays["actor"], dtype)
        self._critic = Perceptrons(critic, both["critic"], dtype)
        self._target = Perceptrons(critic, both["target"], dtype)
        self._log_temperature = arrays["log_temperature"]
        temperature_lines = _cache_lines(self._log_temperature)
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
        """Fused Adam of parameters (name, values, gradient, learning rate), with the moments stored in the arrays."""
        groups = [{"params": [values], "lr": rate} for _, values, _, rate in parts]
        adam = Adam(groups, fused=True, capturable=parts[0][1].is_cuda)
        for name, values, gradient, _ in parts:
            values.grad = gradient
            self._counts.append(torch.zeros((), device=values.device))
            moments = {moment: self._arrays[f"{name}/{moment}"] for moment in MOMENTS}
            moments = {m: _cache_lines(own) if own.dim() == 1 else own.view_as(values) for m, own in moments.items()}
            adam.state[values] = {"step": self._counts[-1], **moments}
        return adam

    def changed(self) -> list[Tensor]:
        """All tensors that an update changes and the next one reads."""
        copies = [copy for part in (self._actor, self._critic, self._target) for copy in part.copies()]
        return [*self._arrays.values(), *self._counts, *copies]

    def refresh(self, updates: int) -> None:
        """Call after other code has changed parameters and moments; ``updates`` is the number of updates that they had."""
        for count in self._counts:
            count.fill_(updates)
        for part in (self._actor, self._critic, self._target):
            part.refresh()

    @torch.no_grad()
    def update(self, batch: ReplayBatch, noise: Float[Tensor, "2 G B A"]) -> None:
        """Update temperature, critics, actor and target critics once each, as ``stable_baselines3.SAC.train`` does."""
        experts, count, observed = batch.observations.shape
        temperature = self._temperature(batch)

        self._actor_buffers.input[:, :count] = batch.observations
        self._actor_buffers.input[:, count:] = batch.next_observations
        both = sample(self._actor.forward(self._actor_buffers), torch.cat([noise[0], noise[1]], dim=1))
        current = SquashedSample(*(part[:, :count] for part in both))

        next_value = self._values(self._target, batch.next_observations, both.actions[:, count:]).amin(1)
        next_value -= temperature * both.log_likelihood[:, count:]
        targets = batch.rewards + self._config.gamma * next_value

        error = self._values(self._critic, batch.observations, batch.actions) - targets.unsqueeze(1)
        self._critic.backward(self._critic_buffers, (error / count).view(2 * experts, count, 1))
        self._critic_adam.step()
        self._critic.refresh()

        values = self._values(self._critic, batch.observations, current.actions)
        d_values = torch.zeros_like(values).scatter_(1, values.argmin(1, keepdim=True), -1 / count)
        d_inputs = self._critic.input_gradient(self._critic_buffers, d_values.view(2 * experts, count, 1), observed)
        d_actions = d_inputs.view(experts, 2, count, -1).sum(1)
        self._update_actor(current, d_actions, temperature)
        self._target.flat.lerp_(self._critic.flat, self._config.tau)
        self._target.refresh()

    def _temperature(self, batch: ReplayBatch) -> Float[Tensor, "G #B"]:
        """The temperature of each transition, or one of each expert."""
        return self._log_temperature.exp().unsqueeze(1)

    def _tune_temperature(self, current: SquashedSample) -> None:
        """The temperature's gradient, for an entropy of -A."""
        torch.neg(current.log_likelihood.mean(1) - current.actions.shape[2], out=self._temperature_gradient[:, 0])

    def _update_actor(
        self, current: SquashedSample, d_actions: Float[Tensor, "G B A"], temperature: Float[Tensor, "G #B"]
    ) -> None:
        """Minimize the mean of temperature * log likelihood - min of both values; tune the temperature.

        ``d_actions``: the derivative of -value by the actions.
        """
        weight = (temperature / current.actions.shape[1]).unsqueeze(2)
        d_u = current.da_du * (d_actions + weight * 2 * current.actions / (current.da_du + _EPSILON))
        mean, deviation = self._output_gradient.chunk(2, dim=2)
        mean.copy_(d_u)
        torch.sub(d_u * current.du_dlog, weight * current.unclamped, out=deviation)
        self._actor.backward(self._actor_buffers, self._output_gradient)
        self._tune_temperature(current)
        self._actor_adam.step()
        self._actor.refresh()

    def _values(
        self, critics: Perceptrons, observations: Float[Tensor, "G B S"], actions: Float[Tensor, "G B A"]
    ) -> Float[Tensor, "G 2 B"]:
        """The values of both critics of each expert."""
        experts, count, observed = observations.shape
        inputs = self._critic_buffers.input.view(experts, 2, count, -1)
        inputs[..., :observed] = observations.unsqueeze(1)
        inputs[..., observed:] = actions.unsqueeze(1)
        return critics.forward(self._critic_buffers).view(experts, 2, count)


class GivenTemperature(Lockstep):
    """As ``Lockstep``, but the last component of an observation is the temperature, which is not learned (QARL's adversary)."""

    def _temperature(self, batch: ReplayBatch) -> Float[Tensor, "G B"]:
        return batch.observations[..., -1]

    def _tune_temperature(self, current: SquashedSample) -> None:
        """Leaves the gradient at 0."""
