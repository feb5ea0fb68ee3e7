"""Experts as files of stable-baselines3: copies stacked parameters to its networks and back."""

from __future__ import annotations

import io
import json
import pickle
import re
import zipfile
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
from icrl_dist.stream.excerpts import plain, show
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

    Nothing of the file is unpickled as an object, so a file from others executes no code: only its tensors and the
    readable part of its JSON are read.  (``stable_baselines3.SAC.load`` executes what a file says.)

    Raises ValueError for another shape, activation, action range or a fixed temperature, and for any other file.
    """
    try:
        about, tensors = _read(path)
        policy = tensors["policy"]
        layers = [value for name, value in policy.items() if re.fullmatch(r"actor\.latent_pi\.\d+\.weight", name)]
        found = (layers[0].shape[1:], policy["actor.mu.bias"].shape, [len(layer) for layer in layers])
        low, high, activation = _space_and_activation(about)
    except (OSError, zipfile.BadZipFile, *_MALFORMED) as error:
        raise _unreadable(path, error) from error
    if found != ((spec.observation,), (spec.actions,), list(config.hidden)):
        raise ValueError(
            f"{path} holds an expert of {tuple(found[0])} observations, {tuple(found[1])} actions and hidden layers "
            f"{found[2]}, not {spec.observation}, {spec.actions} and {config.hidden}: "
            "load it with its own spec and hidden layers"
        )
    if activation != "ReLU" or set(low) != {-1.0} or set(high) != {1.0}:
        raise ValueError(
            f"{path} holds an expert with activation {plain(activation)} and actions from {show(low)} to {show(high)}: "
            "train it with ReLU, and with actions rescaled to [-1, 1]"
        )
    if "ent_coef_optimizer" not in tensors:
        raise ValueError(f"{path}: {_FIXED_TEMPERATURE}")
    try:
        return _arrays(tensors, spec, config, shapes)
    except _MALFORMED as error:
        raise _unreadable(path, error) from error


_FIXED_TEMPERATURE = "the temperature is fixed: train it with an automatic temperature (ent_coef='auto')"
_MALFORMED = (KeyError, IndexError, TypeError, AttributeError, ValueError, RuntimeError, EOFError, pickle.UnpicklingError)
"""What the parts of a malformed file raise."""


def _unreadable(path: Path, error: Exception) -> ValueError:
    return ValueError(f"{path} is no file of stable-baselines3's SAC that can be read: {plain(str(error))}; save it again")


def _read(path: Path) -> tuple[dict[str, Any], dict[str, dict[str, Any]]]:
    """The JSON of a file, and the tensors of its members by name."""
    with zipfile.ZipFile(path) as file:
        if sum(member.file_size for member in file.infolist()) > path.stat().st_size:
            raise ValueError("it would unpack to more than its own size")
        members = [name for name in file.namelist() if name.endswith(".pth")]
        read = {name: torch.load(io.BytesIO(file.read(name)), "cpu", weights_only=True) for name in members}
        return json.loads(file.read("data")), {
            name.removesuffix(".pth").replace(".optimizer", "_optimizer"): read[name] for name in members
        }


def _space_and_activation(about: Mapping[str, Any]) -> tuple[list[float], list[float], str]:
    """The least and largest actions, and the name of the activation, from the readable part of the JSON."""
    space = about["action_space"]
    low, high = ([float(number) for number in space[name].strip("[]").split()] for name in ("low", "high"))
    activation = str(about["policy_kwargs"].get("activation_fn", nn.ReLU))
    return low, high, activation.rpartition(".")[2].removesuffix("'>")


def _arrays(
    tensors: Mapping[str, Mapping[str, Any]], spec: Spec, config: SACConfig, shapes: Shapes
) -> tuple[dict[str, Tensor], int]:
    model = blank(spec, config)
    model.policy.load_state_dict(tensors["policy"])
    optimizers = {"actor": "actor_optimizer", "critic": "critic_optimizer", "log_temperature": "ent_coef_optimizer"}
    for name, member in optimizers.items():
        _optimizer(model, name).load_state_dict(dict(tensors[member]))
    actor, critic = (torch.zeros(shape.parameters) for shape in shapes)
    arrays = {"actor": actor, "critic": torch.stack([critic, critic]), "log_temperature": torch.zeros(())}
    arrays |= {f"{name}/{moment}": torch.zeros_like(arrays[name]) for name in TRAINED for moment in MOMENTS}
    arrays["target"] = torch.zeros_like(arrays["critic"])
    state = _optimizer(model, "actor").state
    updates = int(next(iter(state.values()))["step"]) if state else 0
    with torch.no_grad():
        _optimizer(model, "log_temperature").param_groups[0]["params"][0].copy_(tensors["pytorch_variables"]["log_ent_coef"])
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
        raise ValueError(_FIXED_TEMPERATURE)
    return optimizer
