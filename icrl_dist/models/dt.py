"""The decision transformer of prompt-DT and ARDT: a prompt and a window of (return-to-go, state, action) in, actions out.

The tokens of a prompt come first.  Each token of the window sees the valid tokens of the prompt, and those of the window
up to itself.  Prompt and window have their own embeddings, and every token also has that of its step in the episode.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float, Float32
from torch import Tensor, nn
from torch.nn import functional as F

from icrl_dist.config.sections import ModelConfig
from icrl_dist.interfaces import Actions
from icrl_dist.models.features import Features
from icrl_dist.models.gpt import GPT, Block, KVCache, causal_mask
from icrl_dist.models.sampling import sample
from icrl_dist.models.segments import PromptBatch, Segments
from icrl_dist.types import Spec

TOKENS = 3
"""Tokens of a step: return-to-go, state, action."""


class Encoded(NamedTuple):
    """Keys and values of T tokens of each of B rows, a prompt and the steps after it, and which of them later tokens see."""

    cache: KVCache
    visible: Bool[Tensor, "B T"]


class StepEmbedding(nn.Module):
    """The tokens of consecutive steps."""

    def __init__(self, observation: int, actions: int, horizon: int, width: int) -> None:
        super().__init__()
        self.to_go, self.state = nn.Linear(1, width), nn.Linear(observation, width)
        self.action, self.step = nn.Linear(actions, width), nn.Embedding(horizon, width)

    def forward(
        self, to_go: Float[Tensor, "B L 1"], states: Float[Tensor, "B L F"], actions: Float[Tensor, "B L A"], steps: Tensor
    ) -> Float[Tensor, "B 3*L D"]:
        """Of every step the return-to-go, then the state, then the action."""
        tokens = torch.stack([self.to_go(to_go), self.state(states), self.action(actions)], dim=2)
        return (tokens + self.step(steps).unsqueeze(2)).flatten(1, 2)


class DecisionTransformer(nn.Module):
    """The action at every state of a window, given the returns-to-go so far, the steps before it, and a prompt.

    Outputs are logits of discrete actions, or of vectors the values that ``tanh`` maps to [-1, 1].
    """

    target: Tensor
    scale: Tensor

    def __init__(self, spec: Spec, config: ModelConfig, window: int, prompt: int) -> None:
        """``window`` and ``prompt``: steps of each at deployment."""
        super().__init__()
        self.spec, self.window, self.prompt = spec, window, prompt
        self._features = Features(spec, config.fourier)
        # Stored with the weights: from the first training batch on those of the dataset (``PromptBatch``).
        self.register_buffer("target", torch.zeros(()))
        self.register_buffer("scale", torch.ones(()))
        inputs = (spec.observation * (1 + 2 * config.fourier), spec.actions, spec.horizon, config.width)
        self.embed_prompt, self.embed_window = StepEmbedding(*inputs), StepEmbedding(*inputs)
        self.trunk = GPT(config.layers, config.heads, config.width, config.dropout)
        self.head = nn.Linear(config.width, spec.actions)
        for name, module in self.named_modules():
            if isinstance(module, nn.Linear):  # as in ``models.dpt``
                residual = 2 * config.layers if name.endswith((".out", ".feed.2")) else 1
                nn.init.normal_(module.weight, std=(module.in_features * residual) ** -0.5)
                nn.init.zeros_(module.bias)
            elif isinstance(module, nn.Embedding):
                nn.init.normal_(module.weight, std=0.3)

    def _tokens(self, embed: StepEmbedding, steps: Segments) -> Float[Tensor, "B T D"]:
        columns = (
            steps.to_go[..., None] / np.float32(self.scale.item()),
            self._features.observations(steps.observations),
            self._features.actions(steps.actions),
            steps.steps,
        )
        tokens: Tensor = embed(*map(self._put, columns))
        return tokens

    def _put(self, array: np.ndarray) -> Tensor:
        return torch.from_numpy(np.ascontiguousarray(array)).to(self.scale.device)

    def encode(self, prompt: Segments) -> Encoded:
        """Prompts; later tokens see their valid steps only."""
        visible = self._put(prompt.valid).repeat_interleave(TOKENS, dim=1)
        return Encoded(self.trunk.encode(self._tokens(self.embed_prompt, prompt)), visible)

    def forward(self, prompt: Encoded, window: Segments) -> Float[Tensor, "B L A"]:
        """Outputs at every state of the windows; those at padding have no meaning.

        Padding is at the end of a window, so no valid token sees it.  No state sees its own action.
        """
        tokens = self._tokens(self.embed_window, window)[:, :-1]  # no state comes after the last action
        return self._extend(tokens, prompt, slice(1, None, TOKENS))[0]

    def _extend(self, x: Float[Tensor, "B N D"], past: Encoded, wanted: slice) -> tuple[Float[Tensor, "B W A"], KVCache]:
        """Outputs at the ``wanted`` of N tokens that follow others, and the keys and values of all T + N tokens."""
        batch, new = x.shape[:2]
        causal = causal_mask(new, x.device).expand(batch, -1, -1)
        visible = torch.cat([past.visible[:, None].expand(-1, new, -1), causal], dim=-1)[:, None]
        cache: KVCache = []
        for block, (keys, values) in zip(self.trunk.blocks, past.cache, strict=True):
            assert isinstance(block, Block)
            q, k, v = block.attn_qkv(x)
            cache.append((torch.cat([keys, k], dim=2), torch.cat([values, v], dim=2)))
            if len(cache) == len(past.cache):  # what follows concerns each token alone
                q, x, visible = q[:, :, wanted], x[:, wanted], visible[:, :, wanted]
            x = block.attn_out_and_mlp(x, F.scaled_dot_product_attention(q, *cache[-1], attn_mask=visible))
        outputs: Tensor = self.head(self.trunk.norm(x))
        return outputs, cache

    def loss(self, batch: PromptBatch) -> Float[Tensor, ""]:
        """The mean over valid steps of -log P(action), or of the squared error of vectors; keeps ``target`` and ``scale``."""
        self.target.fill_(batch.target)
        self.scale.fill_(batch.scale)
        outputs = self(self.encode(batch.prompt), batch.window)
        valid, actions = self._put(batch.window.valid), self._put(batch.window.actions)
        if self.spec.discrete:
            return F.cross_entropy(outputs[valid], actions[valid])
        return F.mse_loss(outputs[valid].tanh(), actions[valid])

    @torch.inference_mode()
    def encode_frozen(self, prompt: Segments) -> Encoded:
        """``encode`` without gradients, for deployment."""
        return self.encode(prompt)

    @torch.inference_mode()
    def decide(self, past: Encoded, steps: Segments) -> tuple[Float32[np.ndarray, "B A"], Encoded]:
        """Outputs at the last state of steps without padding; and ``past`` followed by all of these steps but the last."""
        tokens = self._tokens(self.embed_window, steps)[:, :-1]
        outputs, cache = self._extend(tokens, past, slice(-1, None))
        known = cache[0][0].shape[2] - 2  # without return-to-go and state of the last step
        visible = F.pad(past.visible, (0, known - past.visible.shape[1]), value=True)
        return outputs[:, 0].cpu().numpy(), Encoded([(k[:, :, :known], v[:, :, :known]) for k, v in cache], visible)

    def act(self, outputs: Float32[np.ndarray, "B A"], u: Float[np.ndarray, "B U"]) -> Actions:
        """The action of each row: discrete ones sampled by the uniform numbers, vectors as they are."""
        if self.spec.discrete:
            return sample(self.probabilities(outputs), u[:, 0])
        return np.tanh(outputs)

    def probabilities(self, outputs: Float32[np.ndarray, "B A"]) -> Float32[np.ndarray, "B A"]:
        """The distribution over discrete actions."""
        found: np.ndarray = torch.from_numpy(outputs).softmax(-1).numpy()
        return found
