"""Experts as files of stable-baselines3: each row of stacked parameters is one of its networks, and back."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import stable_baselines3
import torch
from torch import Tensor, nn

from icrl_dist.algos.sac import SACConfig, expert
from icrl_dist.algos.stacked import Shape
from icrl_dist.types import Spec

TRAINED = ("actor", "critic", "log_temperature")
"""What Adam trains."""
MOMENTS = ("exp_avg", "exp_avg_sq")
"""Adam's averages of gradients and of their squares, by torch's names."""

Slot = Callable[[nn.Parameter], Tensor]


class _Spaces(gymnasium.Env[np.ndarray, np.ndarray]):
    """A game's spaces without a game."""

    def __init__(self, spec: Spec) -> None:
        self.observation_space = gymnasium.spaces.Box(np.array(spec.low, np.float32), np.array(spec.high, np.float32))
        self.action_space = gymnasium.spaces.Box(-1.0, 1.0, (spec.actions,))


def save(
    path: Path, spec: Spec, config: SACConfig, shapes: tuple[Shape, Shape], arrays: Mapping[str, Tensor], updates: int
) -> None:
    """Write one expert's ``arrays`` (names as in ``SACBatch.arrays``), with Adam's state after ``updates``."""
    with torch.random.fork_rng(devices=[]):  # it draws weights that are overwritten at once
        model = expert(_Spaces(spec), config, None, "cpu")
    for name, flat, shape, layers in _networks(model, shapes):
        _copy(flat(arrays[name]), shape, layers, _value, write=True)
    assert model.log_ent_coef is not None
    model.log_ent_coef.data.fill_(arrays["log_temperature"])
    if updates:
        for name in TRAINED:
            optimiser = _optimiser(model, name)
            for parameter in optimiser.param_groups[0]["params"]:
                moments = {moment: torch.zeros_like(parameter) for moment in MOMENTS}
                optimiser.state[parameter] = {"step": torch.tensor(float(updates)), **moments}
        for moment in MOMENTS:
            for name, flat, shape, layers in _networks(model, shapes)[:2]:
                _copy(flat(arrays[f"{name}/{moment}"]), shape, layers, _moment(_optimiser(model, name), moment), write=True)
            _moment(_optimiser(model, "log_temperature"), moment)(model.log_ent_coef).fill_(
                arrays[f"log_temperature/{moment}"]
            )
    model._n_updates = updates
    model.save(path)


def load(path: Path, spec: Spec, config: SACConfig, shapes: tuple[Shape, Shape]) -> tuple[dict[str, Tensor], int]:
    """One expert's arrays, and after how many updates.  Raises ValueError for another shape."""
    with torch.random.fork_rng(devices=[]):
        model = stable_baselines3.SAC.load(path, device="cpu", custom_objects={"buffer_size": 1})
    seen, acted = model.observation_space.shape, model.action_space.shape
    hidden = tuple(model.policy.net_arch) if isinstance(model.policy.net_arch, list) else model.policy.net_arch
    if (seen, acted, hidden) != ((spec.observation,), (spec.actions,), config.hidden):
        raise ValueError(
            f"{path} holds an expert of {seen} observations, {acted} actions and hidden layers {hidden}, "
            f"not {spec.observation}, {spec.actions} and {config.hidden}: load it into its own shape"
        )
    if model.log_ent_coef is None:
        raise ValueError(f"{path} has a fixed temperature: only experts that tune it can go on here")
    arrays: dict[str, Tensor] = {}
    for name, flat, shape, layers in _networks(model, shapes):
        arrays[name] = torch.zeros(*((2,) if name != "actor" else ()), shape.parameters)
        _copy(flat(arrays[name]), shape, layers, _value, write=False)
    arrays["log_temperature"] = model.log_ent_coef.detach()[0].clone()
    arrays |= {f"{name}/{moment}": torch.zeros_like(arrays[name]) for name in TRAINED for moment in MOMENTS}
    updates = 0
    for name, flat, shape, layers in _networks(model, shapes)[:2]:
        optimiser = _optimiser(model, name)
        if optimiser.state:
            updates = int(next(iter(optimiser.state.values()))["step"])
            for moment in MOMENTS:
                _copy(flat(arrays[f"{name}/{moment}"]), shape, layers, _moment(optimiser, moment), write=False)
                temperature = _optimiser(model, "log_temperature")
                arrays[f"log_temperature/{moment}"].copy_(_moment(temperature, moment)(model.log_ent_coef)[0])
    return arrays, updates


def _networks(
    model: stable_baselines3.SAC, shapes: tuple[Shape, Shape]
) -> list[tuple[str, Callable[[Tensor], Tensor], Shape, list[list[list[nn.Linear]]]]]:
    """Of actor, critics and target critics: name, its array as rows, shape, and its linear layers.

    The layers are given row by row and layer by layer; those whose outputs lie side by side in one
    layer of ours stand together.
    """
    def linear(parts: Any) -> list[list[nn.Linear]]:
        return [[part] for part in parts if isinstance(part, nn.Linear)]

    heads = [model.actor.mu, model.actor.log_std]
    actor: list[list[nn.Linear]] = [*linear(model.actor.latent_pi), [h for h in heads if isinstance(h, nn.Linear)]]
    return [
        ("actor", lambda flat: flat.unsqueeze(0), shapes[0], [actor]),
        ("critic", lambda flat: flat, shapes[1], [linear(part) for part in model.critic.q_networks]),
        ("target", lambda flat: flat, shapes[1], [linear(part) for part in model.critic_target.q_networks]),
    ]


def _copy(rows: Tensor, shape: Shape, networks: list[list[list[nn.Linear]]], slot: Slot, write: bool) -> None:
    """Rows (M, P) into ``slot`` of M networks' parameters (``write``), or from there.

    torch keeps a layer's weights as (out, in), ours are (in, out).
    """
    for (weights, bias), *layers in zip(shape.layers(rows), *networks, strict=True):
        for row, parts in enumerate(layers):
            at = 0
            for part in parts:
                end = at + part.out_features
                pairs = (weights[row, :, at:end].T, slot(part.weight)), (bias[row, 0, at:end], slot(part.bias))
                for ours, theirs in pairs:
                    (theirs if write else ours).copy_(ours if write else theirs)
                at = end


def _value(parameter: nn.Parameter) -> Tensor:
    return parameter.data


def _moment(optimiser: torch.optim.Optimizer, moment: str) -> Callable[[Tensor], Tensor]:
    return lambda parameter: optimiser.state[parameter][moment]


def _optimiser(model: stable_baselines3.SAC, name: str) -> torch.optim.Optimizer:
    found = {"actor": model.actor, "critic": model.critic}
    return model.ent_coef_optimizer if name == "log_temperature" else found[name].optimizer
