"""The compiled decoder where contexts are so large that it brings them into the cache ahead of their use."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
import torch

from icrl_dist.models import decoder
from icrl_dist.models.compiled import kinds
from icrl_dist.models.gpt import GPT
from icrl_dist.models.kernel import Kernel
from icrl_dist.models.kernel_decoder import KernelDecoder

pytestmark = pytest.mark.skipif(not kinds(), reason="the kernel was not built here")


@pytest.mark.parametrize("kind", kinds())
@pytest.mark.parametrize(
    ("width", "heads", "batch", "length"), [(32, 1, 33, 130), (20, 5, 21, 128), (16, 4, 40, 127), (32, 2, 1, 1700)]
)
def test_decisions_do_not_depend_on_other_contexts_and_equal_torchs(
    kind: str, width: int, heads: int, batch: int, length: int
) -> None:
    torch.manual_seed(0)
    trunk = GPT(3, heads, width, 0.0).eval()
    weights = {name: value.numpy() for name, value in trunk.state_dict().items()}
    context, query, window = torch.randn(batch, length, width), torch.randn(batch, width), torch.randn(batch, 5, width)
    far = KernelDecoder(weights, heads, batch, Kernel(kind))
    alone = KernelDecoder(weights, heads, 1, Kernel(kind))
    with torch.inference_mode():
        of_torch = decoder.Decoder(trunk, batch)
        of_torch.append(context)
        far.append(context.numpy())
        assert far._decoder.far_away == 1
        found = far.query(query.numpy()), far.window(window.numpy())
        expected = of_torch.query(query), of_torch.window(window)
    for one, other in zip(found, expected, strict=True):
        np.testing.assert_allclose(one, other.numpy(), atol=1e-5)
    for row in {0, batch - 1}:
        alone.clear()
        alone.append(context[row : row + 1].numpy())
        assert (alone.query(query[row : row + 1].numpy())[0] == found[0][row]).all()
        assert (alone.window(window[row : row + 1].numpy())[0] == found[1][row]).all()


def test_a_context_that_finds_no_memory_keeps_what_it_has(monkeypatch: pytest.MonkeyPatch) -> None:
    trunk = GPT(1, 1, 16, 0.0)
    made = KernelDecoder({name: value.numpy() for name, value in trunk.state_dict().items()}, 1, 2, Kernel())
    made.append(np.ones((2, 20, 16), np.float32))
    first, zeros, calls = made.query(np.ones((2, 16), np.float32)), np.zeros, itertools.count()

    def without_memory(shape: tuple[int, ...], kind: type) -> np.ndarray:
        if next(calls):
            raise MemoryError
        return zeros(shape, kind)

    with monkeypatch.context() as patch:
        patch.setattr(np, "zeros", without_memory)
        with pytest.raises(MemoryError):
            made.append(np.ones((2, 300, 16), np.float32))
    assert len(made._pointers) == len(made._chunks) == 1
    assert made.length == 20 and (made.query(np.ones((2, 16), np.float32)) == first).all()


def test_a_repeated_decision_clears_no_places() -> None:
    """Clearing places that the next call writes again took as long as a tenth of the decision."""
    trunk = GPT(1, 1, 16, 0.0)
    made = KernelDecoder({name: value.numpy() for name, value in trunk.state_dict().items()}, 1, 2, Kernel())
    made.append(np.ones((2, 20, 16), np.float32))
    first = made.query(np.ones((2, 16), np.float32))
    made._chunks[0].flags.writeable = False
    assert (made.query(np.ones((2, 16), np.float32)) == first).all()
    with pytest.raises(ValueError, match="read-only"):
        made.clear()
