"""A return-to-go transformer: tokens (return-to-go, state, previous action), trained to repeat actions."""

from dataclasses import dataclass

import numpy as np
import torch
from torch import nn

from icrl_dist.config.ranges import PositiveFloat
from icrl_dist.interfaces import Method, Phase
from icrl_dist.methods import jobs
from icrl_dist.models.sampling import sample
from icrl_dist.problems import registry


@dataclass(frozen=True)
class ReturnToGoConfig:
    target: PositiveFloat = 5.0


class ReturnToGoTransformer(nn.Module):
    def __init__(self, spec, width, layers):
        super().__init__()
        self.actions, self.length = spec.actions, spec.horizon
        self.embed = nn.Linear(1 + spec.observation + spec.actions + 1, width)
        layer = nn.TransformerEncoderLayer(width, 1, 2 * width, dropout=0.0, batch_first=True)
        self.trunk, self.head = nn.TransformerEncoder(layer, layers, enable_nested_tensor=False), nn.Linear(width, spec.actions)

    def forward(self, to_go, states, previous):  # (B, T), (B, T, S), (B, T) with -1 at the start
        one_hot = nn.functional.one_hot(previous + 1, self.actions + 1).float()
        mask = nn.Transformer.generate_square_subsequent_mask(to_go.shape[1])
        return self.head(self.trunk(self.embed(torch.cat([to_go[..., None], states, one_hot], -1)), mask, is_causal=True))


class ReturnToGoPolicy:
    def __init__(self, model, batch, target):
        self.model, self.start = model, (np.full(batch, target, np.float32), np.full(batch, -1))
        self.to_go, self.previous, self.steps = *self.start, []

    def act(self, observation, u):
        self.steps.append((self.to_go, observation.copy(), self.previous))
        columns = [torch.from_numpy(np.stack(column, axis=1)) for column in zip(*self.steps, strict=True)]
        with torch.inference_mode():
            return sample(self.model(*columns)[:, -1].softmax(-1).numpy(), u[:, 0])

    def observe(self, observation, action, reward, next_observation, done):
        self.to_go, self.previous = (self.to_go - reward).astype(np.float32), action.astype(np.int64)
        if done:
            self.to_go, self.previous, self.steps = *self.start, []


class ReturnToGo(Method):
    name, section, Config = "return-to-go", "return_to_go", ReturnToGoConfig

    def phases(self, run):
        return (Phase("pretrain", 0, run.pretrain.steps, 1e-3), Phase("adapt", 0, 10, 1e-3))

    def training_variations(self, run, index, task, round):
        return registry.training_variations(run, index, task, round)

    def ask(self, run, phase):
        def choose(index, task):
            return self.training_variations(run, index, task, phase.round)

        if phase.stage == "pretrain":
            return jobs.pretraining_contexts(run, phase, choose)
        return jobs.rollouts(run, phase, choose, 3, "paper")

    def data(self, run, phase, dataset):
        keys = [*dataset.variations("pretrain", 0), *(dataset.variations("adapt", 0) if phase.stage == "adapt" else ())]
        return lambda rng: [rng.choice(dataset.trials(keys[i])) for i in rng.integers(0, len(keys), size=run.optim.batch)]

    def build(self, spec, run):
        return ReturnToGoTransformer(spec, run.model.width, run.model.layers)

    def loss(self, model, batch):
        rewards, actions = np.stack([t.rewards for t in batch]), np.stack([t.actions for t in batch]).astype(np.int64)
        to_go = np.flip(np.flip(rewards, 1).cumsum(1), 1).astype(np.float32)
        previous = np.concatenate([np.full((len(batch), 1), -1), actions[:, :-1]], axis=1)
        states = np.stack([t.observations[:-1] for t in batch])
        logits = model(*(torch.from_numpy(a.copy()) for a in (to_go, states, previous)))
        return nn.functional.cross_entropy(logits.flatten(0, 1), torch.from_numpy(actions).flatten())

    def policy(self, model, batch, context, deploy=None, watch=None):
        return ReturnToGoPolicy(model.eval(), batch, 5.0)
