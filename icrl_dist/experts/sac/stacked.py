"""M stacked perceptrons of one shape: forward and backward take one batched product per layer for all of them.

The backward pass is written by hand instead of by autograd: products go to preallocated buffers, weights
that do not change get no gradient, and an update allocates nothing.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor

ALIGNED = 16
"""float32 values per cache line."""

Layer = tuple[Float[Tensor, "M I O"], Float[Tensor, "M 1 O"]]
"""Weights and bias of one layer."""


class Shape:
    """The layout of a perceptron's layers (ReLU between layers) in one flat row of parameters."""

    def __init__(self, sizes: Sequence[int]) -> None:
        self.sizes = tuple(sizes)
        """Inputs, units of each hidden layer, outputs."""
        used = sum((rows + 1) * columns for rows, columns in zip(self.sizes, self.sizes[1:], strict=False))
        self.parameters = -(-used // ALIGNED) * ALIGNED
        """Length of a row, P, padded to whole cache lines; the padding is 0 and stays 0."""

    def layers(self, flat: Float[Tensor, "M P"]) -> list[Layer]:
        """Each layer as a view into ``flat``."""
        layers, at, stacked = [], 0, len(flat)
        for rows, columns in zip(self.sizes, self.sizes[1:], strict=False):
            weights = flat[:, at : at + rows * columns].view(stacked, rows, columns)
            at += rows * columns
            layers.append((weights, flat[:, at : at + columns].view(stacked, 1, columns)))
            at += columns
        return layers

    def draw(self, stacked: int, generator: torch.Generator) -> Float[Tensor, "M P"]:
        """Initial parameters, distributed as in ``torch.nn.Linear``: uniform within 1 / sqrt(inputs)."""
        flat = torch.zeros(stacked, self.parameters)
        for (weights, bias), rows in zip(self.layers(flat), self.sizes, strict=False):
            for part in (weights, bias):
                part.uniform_(-1 / math.sqrt(rows), 1 / math.sqrt(rows), generator=generator)
        return flat


class Buffers:
    """Activations of a forward pass over R rows, and room for the gradients of the backward pass."""

    def __init__(self, shape: Shape, stacked: int, rows: int, dtype: torch.dtype, device: torch.device) -> None:
        def empty(width: int, dtype: torch.dtype = dtype) -> Tensor:
            return torch.empty(stacked, rows, width, dtype=dtype, device=device)

        self.input = empty(shape.sizes[0])
        self.hidden = [empty(width) for width in shape.sizes[1:-1]]
        self.gradients = [empty(width) for width in shape.sizes[1:-1]]
        self.output = empty(shape.sizes[-1], torch.float32)


class Perceptrons:
    """M perceptrons over given float32 parameters (M, P).

    With ``dtype`` bfloat16, all products but the last layer's are in bfloat16, on a copy of the parameters;
    ``flat`` and ``gradient`` are float32.
    """

    def __init__(self, shape: Shape, flat: Float[Tensor, "M P"], dtype: torch.dtype = torch.float32) -> None:
        self.shape, self.flat, self.gradient = shape, flat, torch.zeros_like(flat)
        same = dtype == torch.float32
        self._low, self._low_gradient = (flat, self.gradient) if same else (flat.to(dtype), flat.to(dtype))
        self._layers, self._gradients = shape.layers(self._low), shape.layers(self._low_gradient)
        self._last, self._last_gradient = shape.layers(flat)[-1], shape.layers(self.gradient)[-1]

    def copies(self) -> list[Tensor]:
        """The copy of the parameters in ``dtype``, if there is one."""
        return [] if self._low is self.flat else [self._low]

    def refresh(self) -> None:
        """Update the copy of the parameters: call it after every change of them, before ``forward``."""
        if self._low is not self.flat:
            self._low.copy_(self.flat)

    def forward(self, buffers: Buffers) -> Float[Tensor, "M R O"]:
        """Outputs for ``buffers.input``."""
        x = buffers.input
        for (weights, bias), hidden in zip(self._layers, buffers.hidden, strict=False):
            x = torch.baddbmm(bias, x, weights, out=hidden).relu_()
        return torch.baddbmm(self._last[1], x.float(), self._last[0], out=buffers.output)

    def backward(self, buffers: Buffers, d_output: Float[Tensor, "M r O"]) -> None:
        """Write ``gradient``, given the loss's derivative by the outputs of the first r rows."""
        rows, weights, bias = d_output.shape[1], *self._last_gradient
        d_hidden = self._through_last(buffers, d_output)
        for layer in reversed(range(len(self._gradients) - 1)):
            x = buffers.hidden[layer - 1] if layer else buffers.input
            torch.bmm(x[:, :rows].mT, d_hidden, out=self._gradients[layer][0])
            torch.sum(d_hidden, 1, keepdim=True, out=self._gradients[layer][1])
            if layer:
                d_hidden = self._through(buffers, layer, d_hidden)
        if self._low is not self.flat:
            self.gradient.copy_(self._low_gradient)
        torch.bmm(buffers.hidden[-1][:, :rows].float().mT, d_output, out=weights)
        torch.sum(d_output, 1, keepdim=True, out=bias)

    def input_gradient(self, buffers: Buffers, d_output: Float[Tensor, "M R O"], first: int) -> Float[Tensor, "M R i"]:
        """The loss's derivative by the inputs from number ``first`` on; ``gradient`` does not change."""
        d_hidden = self._through_last(buffers, d_output)
        for layer in reversed(range(1, len(buffers.hidden))):
            d_hidden = self._through(buffers, layer, d_hidden)
        return torch.bmm(d_hidden, self._layers[0][0][:, first:].mT).float()

    def _through_last(self, buffers: Buffers, d_output: Tensor) -> Tensor:
        """The derivative by the last hidden layer before its ReLU, from that by the outputs."""
        weights, gradient = self._last[0].mT, buffers.gradients[-1][:, : d_output.shape[1]]
        if gradient.dtype == torch.float32:
            torch.bmm(d_output, weights, out=gradient)
        else:
            gradient.copy_(torch.bmm(d_output, weights))
        return _mask_relu(gradient, buffers.hidden[-1])

    def _through(self, buffers: Buffers, layer: int, d_hidden: Tensor) -> Tensor:
        """The derivative by hidden layer ``layer - 1`` before its ReLU, from that by the next layer before its ReLU."""
        gradient = buffers.gradients[layer - 1][:, : d_hidden.shape[1]]
        torch.bmm(d_hidden, self._layers[layer][0].mT, out=gradient)
        return _mask_relu(gradient, buffers.hidden[layer - 1])


def _mask_relu(gradient: Tensor, hidden: Tensor) -> Tensor:
    """Multiply by the derivative of ReLU, in place: 0 where its output was 0."""
    positive = hidden[:, : gradient.shape[1]]
    torch.ops.aten.threshold_backward.grad_input(gradient, positive, 0, grad_input=gradient)
    return gradient


def outputs(shape: Shape, flat: Float[Tensor, "M P"], inputs: Float[Tensor, "M R I"]) -> Float[Tensor, "M R O"]:
    """Outputs of M perceptrons with parameters ``flat`` in float32, without buffers."""
    *hidden, (weights, bias) = shape.layers(flat)
    for hidden_weights, hidden_bias in hidden:
        inputs = torch.baddbmm(hidden_bias, inputs, hidden_weights).relu_()
    return torch.baddbmm(bias, inputs, weights)
