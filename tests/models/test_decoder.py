"""The decoder of deployment: growing contexts lead to the decisions of training."""

from __future__ import annotations

import itertools

import pytest
import torch

from icrl_dist.models import decoder
from icrl_dist.models.dpt import DeployedTransformer
from tests.models.deployments import Deploy, close, columns
from tests.models.networks import B, T, build, part, states, transitions


@torch.no_grad()
@pytest.mark.parametrize(("heads", "width"), [(1, 32), (2, 32), (1, 64), (4, 64)])
@pytest.mark.parametrize("cuts", [(0, 20), (0, 7, 20), (0, 0, 1, 2, 19, 20), tuple(range(21))], ids=str)
def test_a_context_appended_in_pieces_gives_the_outputs_of_training(
    cuts: tuple[int, ...], heads: int, width: int, deploy: Deploy
) -> None:
    model, whole, queries = build(3, heads, width), transitions(), states(T + 1)
    prefixes = model(whole, queries, torch.arange(T + 1).repeat(B, 1))
    deployed = deploy(model, B)
    for start, stop in itertools.pairwise(cuts):
        deployed.append(columns(part(whole, start, stop)))
        assert deployed.length == stop
        for _ in range(2):  # a decision changes nothing
            close(deployed.decide(queries[:, stop].numpy()), prefixes[:, stop])
    assert prefixes.std(dim=1).min() > 1e-3, "outputs hardly depend on the prefix: the comparison would prove nothing"


@torch.no_grad()
@pytest.mark.parametrize("tokens", [1, 25, 40, 10_000])
def test_the_number_of_tokens_processed_at_once_does_not_change_outputs(tokens: int, monkeypatch: pytest.MonkeyPatch) -> None:
    model, whole, queries = build(), transitions(), states()[:, 0]
    monkeypatch.setattr(decoder, "_TOKENS_AT_ONCE", tokens)
    deployed = DeployedTransformer(model, B)
    for start, stop in ((0, 11), (11, T)):
        deployed.append(columns(part(whole, start, stop)))
    expected = model(whole, queries[:, None], torch.full((B, 1), T))[:, 0]
    close(deployed.decide(queries.numpy()), expected)


@torch.no_grad()
def test_clear_empties_contexts_and_later_training_does_not_change_the_decoder(deploy: Deploy) -> None:
    model, queries = build(), states()[:, 0]
    deployed, states_ = deploy(model, B), queries.numpy()
    empty = deployed.decide(states_)
    close(empty, model(transitions(), queries[:, None], torch.zeros(B, 1, dtype=torch.int64))[:, 0])
    deployed.append(columns(transitions()))
    full = deployed.decide(states_)
    assert abs(full - empty).max() > 1e-3
    for parameter in model.parameters():
        parameter.mul_(1.5)
    assert (deployed.decide(states_) == full).all()
    deployed.clear()
    assert deployed.length == 0
    assert (deployed.decide(states_) == empty).all()
