"""Experts as files of stable-baselines3: copies stacked parameters to its networks and back."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import stable_baselines3
import torch
from torch import Tensor, nn

from icrl_dist.config.sac import SACConfig
from icrl_dist.experts.sac.lockstep import MOMENTS, TRAINED
from icrl_dist.experts.sac.sb3_expert import Expert, expert
from icrl_dist.experts.sac.stacked import Shape
from icrl_dist.types import Spec

Shapes = tuple[Shape, Shape]
"""Shapes of the actor and of one critic."""


class _SpacesOnly(gymnasium.Env[np.ndarray, np.ndarray]):
    """The spaces of an environment, without dynamics: stable-baselines3 needs an environment to build networks."""

    def __init__(self, spec: Spec) -> None:
        self.observation_space = gymnasium.spaces.Box(np.array(spec.low, np.float32), np.array(spec.high, np.float32))
        self.action_space = gymnasium.spaces.Box(-1.0, 1.0, (spec.actions,))


def blank(spec: Spec, config: SACConfig) -> Expert:
    """An untrained expert on the CPU, to be filled with weights.  The global generators do not change."""
    with torch.random.fork_rng(devices=[]):
        return expert(_SpacesOnly(spec), config, None, "cpu")


def save(path: Path, spec: Spec, config: SACConfig, shapes: Shapes, arrays: Mapping[str, Tensor], updates: int) -> None:
    """Write one expert's ``arrays`` (named as in ``SACBatch.arrays``) with Adam's state after ``updates`` updates."""
    model = blank(spec, config)
    if updates:
        _init_adam(model, updates)
    with torch.no_grad():
        for ours, theirs in _pairs(model, shapes, arrays, updates > 0):
            theirs.copy_(ours)
    model._n_updates = updates
    model.save(path)


def load(path: Path, spec: Spec, config: SACConfig, shapes: Shapes) -> tuple[dict[str, Tensor], int]:
    """One expert's arrays and its number of updates.

    Raises ValueError for another shape, activation, action range or a fixed temperature.
    """
    with torch.random.fork_rng(devices=[]):
        model = stable_baselines3.SAC.load(path, device="cpu", custom_objects={"buffer_size": 1})
    found = (model.observation_space.shape, model.action_space.shape, model.policy.net_arch)
    if found != ((spec.observation,), (spec.actions,), list(config.hidden)):
        raise ValueError(
            f"{path} holds an expert of {found[0]} observations, {found[1]} actions and hidden layers {found[2]}, "
            f"not {spec.observation}, {spec.actions} and {config.hidden}: load it with its own spec and hidden layers"
        )
    actions: Any = model.action_space
    bounds, activation = (actions.low, actions.high), model.policy.activation_fn
    if activation is not nn.ReLU or (bounds[0] != -1).any() or (bounds[1] != 1).any():
        raise ValueError(
            f"{path} holds an expert with activation {activation.__name__} and actions from {bounds[0].tolist()} to "
            f"{bounds[1].tolist()}: only ReLU and actions in [-1, 1] are supported"
        )
    actor, critic = (torch.zeros(shape.parameters) for shape in shapes)
    arrays = {"actor": actor, "critic": torch.stack([critic, critic]), "log_temperature": torch.zeros(())}
    arrays |= {f"{name}/{moment}": torch.zeros_like(arrays[name]) for name in TRAINED for moment in MOMENTS}
    arrays["target"] = torch.zeros_like(arrays["critic"])
    state = _optimizer(model, "actor").state
    updates = int(next(iter(state.values()))["step"]) if state else 0
    with torch.no_grad():
        for ours, theirs in _pairs(model, shapes, arrays, updates > 0):
            ours.copy_(theirs)
    return arrays, updates


def share(model: Expert, shapes: Shapes, arrays: Mapping[str, Tensor]) -> None:
    """Make the parameters and Adam's moments of ``model`` views of one expert's ``arrays``, so that it trains these."""
    _init_adam(model, 0)
    for ours, theirs in _pairs(model, shapes, arrays, moments=True):
        theirs.data = ours


def set_updates(model: Expert, updates: int) -> None:
    """Set Adam's step count."""
    for name in TRAINED:
        for state in _optimizer(model, name).state.values():
            state["step"].fill_(updates)


def _init_adam(model: Expert, updates: int) -> None:
    """Create Adam's state after ``updates`` steps, with moments of zero."""
    for name in TRAINED:
        optimizer = _optimizer(model, name)
        for parameter in optimizer.param_groups[0]["params"]:
            moments = {moment: torch.zeros_like(parameter) for moment in MOMENTS}
            optimizer.state[parameter] = {"step": torch.tensor(float(updates)), **moments}


def _pairs(
    model: stable_baselines3.SAC, shapes: Shapes, arrays: Mapping[str, Tensor], moments: bool
) -> Iterator[tuple[Tensor, Tensor]]:
    """Pairs of views of the same values, ours and stable-baselines3's: parameters and, with ``moments``, Adam's moments.

    Ours are (in, out), torch's linear layers (out, in).
    """
    heads: list[Any] = [model.actor.mu, model.actor.log_std]  # one layer of ours holds both, side by side
    networks: dict[str, tuple[Shape, list[list[list[nn.Linear]]]]] = {
        "actor": (shapes[0], [[*_linear(model.actor.latent_pi), heads]]),
        "critic": (shapes[1], [_linear(part) for part in model.critic.q_networks]),
        "target": (shapes[1], [_linear(part) for part in model.critic_target.q_networks]),
    }
    for moment in (None, *(MOMENTS if moments else ())):
        suffix = "" if moment is None else f"/{moment}"
        for name, (shape, rows) in networks.items():
            if moment is not None and name not in TRAINED:
                continue
            for (weights, bias), *layers in zip(shape.layers(arrays[name + suffix].view(len(rows), -1)), *rows, strict=True):
                for row, parts in enumerate(layers):
                    at = 0
                    for part in parts:
                        columns = slice(at, at := at + part.out_features)
                        yield weights[row, :, columns].T, _values(model, name, part.weight, moment)
                        yield bias[row, 0, columns], _values(model, name, part.bias, moment)
        theirs = _optimizer(model, "log_temperature").param_groups[0]["params"][0]
        yield arrays["log_temperature" + suffix].view(1), _values(model, "log_temperature", theirs, moment)


def _linear(layers: Any) -> list[list[nn.Linear]]:
    return [[layer] for layer in layers if isinstance(layer, nn.Linear)]


def _values(model: stable_baselines3.SAC, name: str, parameter: Tensor, moment: str | None) -> Tensor:
    """A parameter, or one of Adam's moments of it."""
    return parameter if moment is None else _optimizer(model, name).state[parameter][moment]


def _optimizer(model: stable_baselines3.SAC, name: str) -> torch.optim.Optimizer:
    """The Adam of one of ``TRAINED``.  Raises ValueError for a fixed temperature."""
    found = {"actor": model.actor.optimizer, "critic": model.critic.optimizer, "log_temperature": model.ent_coef_optimizer}
    if (optimizer := found[name]) is None:
        raise ValueError("the temperature is fixed: only experts with an automatic temperature (ent_coef='auto') are supported")
    return optimizer
