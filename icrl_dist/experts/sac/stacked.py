"""Perceptrons of one shape, stacked: M of them take a step of forward or backward in one product a layer.

Derivatives are written out instead of recorded: every product goes to a buffer that is there
already, weights that are not to change get no gradient, and nothing is allocated in an update.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor

ALIGNED = 16
"""Numbers of float32 in a cache line."""

Layer = tuple[Float[Tensor, "M I O"], Float[Tensor, "M 1 O"]]
"""Weights and bias of one layer."""


class Shape:
    """Where each layer of a perceptron (ReLU between layers) lies in a flat row of its parameters."""

    def __init__(self, sizes: Sequence[int]) -> None:
        self.sizes = tuple(sizes)
        """Numbers in, numbers in each hidden layer, numbers out."""
        used = sum((rows + 1) * columns for rows, columns in zip(self.sizes, self.sizes[1:], strict=False))
        self.parameters = -(-used // ALIGNED) * ALIGNED
        """Length of a row, P; what is left over at its end is 0 and stays 0."""

    def layers(self, flat: Float[Tensor, "M P"]) -> list[Layer]:
        """Each layer as a view into ``flat``."""
        found, at, stacked = [], 0, len(flat)
        for rows, columns in zip(self.sizes, self.sizes[1:], strict=False):
            weights = flat[:, at : at + rows * columns].view(stacked, rows, columns)
            at += rows * columns
            found.append((weights, flat[:, at : at + columns].view(stacked, 1, columns)))
            at += columns
        return found

    def draw(self, stacked: int, generator: torch.Generator) -> Float[Tensor, "M P"]:
        """First parameters, by the law of ``torch.nn.Linear``: uniform within 1 / sqrt(numbers in)."""
        flat = torch.zeros(stacked, self.parameters)
        for (weights, bias), rows in zip(self.layers(flat), self.sizes, strict=False):
            for part in (weights, bias):
                part.uniform_(-1 / math.sqrt(rows), 1 / math.sqrt(rows), generator=generator)
        return flat


class Buffers:
    """What a forward pass over R rows leaves for the backward pass, and room for that."""

    def __init__(self, shape: Shape, stacked: int, rows: int, dtype: torch.dtype, device: torch.device) -> None:
        def room(width: int, of: torch.dtype = dtype) -> Tensor:
            return torch.empty(stacked, rows, width, dtype=of, device=device)

        self.input = room(shape.sizes[0])
        self.hidden = [room(width) for width in shape.sizes[1:-1]]
        self.gradients = [room(width) for width in shape.sizes[1:-1]]
        self.output = room(shape.sizes[-1], torch.float32)


class Perceptrons:
    """M perceptrons over float32 parameters (M, P) that somebody else owns.

    With ``dtype`` bfloat16 all products but the last layer's are of bfloat16 numbers; parameters and
    gradients are float32 outside.
    """

    def __init__(self, shape: Shape, flat: Float[Tensor, "M P"], dtype: torch.dtype = torch.float32) -> None:
        self.shape, self.flat, self.gradient = shape, flat, torch.zeros_like(flat)
        same = dtype == torch.float32
        self._low, self._low_gradient = (flat, self.gradient) if same else (flat.to(dtype), flat.to(dtype))
        self._layers, self._gradients = shape.layers(self._low), shape.layers(self._low_gradient)
        self._last, self._last_gradient = shape.layers(flat)[-1], shape.layers(self.gradient)[-1]

    def copies(self) -> list[Tensor]:
        """Parameters as ``dtype``, if they are kept beside the others."""
        return [] if self._low is self.flat else [self._low]

    def refresh(self) -> None:
        """Take up parameters that have changed: to be called before ``forward`` after every change."""
        if self._low is not self.flat:
            self._low.copy_(self.flat)

    def forward(self, buffers: Buffers) -> Float[Tensor, "M R O"]:
        """Outputs for ``buffers.input``."""
        read = buffers.input
        for (weights, bias), hidden in zip(self._layers, buffers.hidden, strict=False):
            read = torch.baddbmm(bias, read, weights, out=hidden).relu_()
        return torch.baddbmm(self._last[1], read.float(), self._last[0], out=buffers.output)

    def backward(self, buffers: Buffers, output: Float[Tensor, "M r O"]) -> None:
        """Write ``gradient``, given the loss's derivative by the outputs of the first r rows."""
        rows, weights, bias = output.shape[1], *self._last_gradient
        above = self._down(buffers, output)
        for layer in reversed(range(len(self._gradients) - 1)):
            read = buffers.hidden[layer - 1] if layer else buffers.input
            torch.bmm(read[:, :rows].mT, above, out=self._gradients[layer][0])
            torch.sum(above, 1, keepdim=True, out=self._gradients[layer][1])
            if layer:
                above = self._through(buffers, layer, above)
        if self._low is not self.flat:
            self.gradient.copy_(self._low_gradient)
        torch.bmm(buffers.hidden[-1][:, :rows].float().mT, output, out=weights)
        torch.sum(output, 1, keepdim=True, out=bias)

    def input_gradient(self, buffers: Buffers, output: Float[Tensor, "M R O"], first: int) -> Float[Tensor, "M R i"]:
        """The loss's derivative by the inputs from number ``first`` on; ``gradient`` stays as it is."""
        above = self._down(buffers, output)
        for layer in reversed(range(1, len(buffers.hidden))):
            above = self._through(buffers, layer, above)
        return torch.bmm(above, self._layers[0][0][:, first:].mT).float()

    def _down(self, buffers: Buffers, output: Tensor) -> Tensor:
        """From the outputs to before the last hidden layer's ReLU."""
        weights, gradient = self._last[0].mT, buffers.gradients[-1][:, : output.shape[1]]
        if gradient.dtype == torch.float32:
            torch.bmm(output, weights, out=gradient)
        else:
            gradient.copy_(torch.bmm(output, weights))
        return _mask(gradient, buffers.hidden[-1])

    def _through(self, buffers: Buffers, layer: int, above: Tensor) -> Tensor:
        """From before the ReLU of a hidden layer to before that of the one below."""
        gradient = buffers.gradients[layer - 1][:, : above.shape[1]]
        torch.bmm(above, self._layers[layer][0].mT, out=gradient)
        return _mask(gradient, buffers.hidden[layer - 1])


def _mask(gradient: Tensor, hidden: Tensor) -> Tensor:
    """ReLU's derivative, in place: nothing passes where it gave 0."""
    passed = hidden[:, : gradient.shape[1]]
    torch.ops.aten.threshold_backward.grad_input(gradient, passed, 0, grad_input=gradient)
    return gradient


def outputs(shape: Shape, flat: Float[Tensor, "M P"], inputs: Float[Tensor, "M R I"]) -> Float[Tensor, "M R O"]:
    """Forward in float32, without buffers."""
    *below, (weights, bias) = shape.layers(flat)
    for one, other in below:
        inputs = torch.baddbmm(other, inputs, one).relu_()
    return torch.baddbmm(bias, inputs, weights)
