"""The in-context benchmark: its data distribution, exact floor and peer, and ratios and verdicts from measurements."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import pytest
import torch

from icrl_dist.bench import incontext, peer
from icrl_dist.bench import incontext_cost as cost
from icrl_dist.bench import incontext_decoder as decoder
from icrl_dist.bench import incontext_quality as quality
from icrl_dist.cli import main
from icrl_dist.config.sections import OptimConfig
from icrl_dist.models.dpt import PretrainedTransformer, Transitions
from icrl_dist.problems.darkroom.bench import DPTContexts, DPTData
from icrl_dist.problems.darkroom.room import MOVES, cells

SPEC = quality.pretraining_data(0).spec
AnyModule = TypeVar("AnyModule", bound=torch.nn.Module)


def test_a_draw_follows_dpts_distribution_and_equal_arguments_give_equal_draws() -> None:
    data = quality.pretraining_data(3)
    assert isinstance(data, DPTData)
    drawn, again, other = (data.draw(0, step, 64, 5) for step in (7, 7, 8))
    for name, column in vars(drawn).items():
        if name == "coordinates":  # of the cells, equal in all draws
            continue
        assert (column == getattr(again, name)).all()
        assert column.shape == getattr(other, name).shape and not (column == getattr(other, name)).all()
    assert len(set(data.hypotheses.goal.tolist())) == quality.GOALS and set(drawn.goal) <= set(data.hypotheses.goal)
    assert np.bincount(drawn.cell.ravel(), minlength=100).min() > 0 and np.bincount(drawn.action.ravel(), minlength=5).min() > 0
    for b in range(8):
        for t in range(quality.LENGTH):
            x, y = np.clip(np.array(divmod(int(drawn.cell[b, t]), 10)) + MOVES[drawn.action[b, t]], 0, 9)
            assert drawn.arrived[b, t] == 10 * x + y and drawn.reward[b, t] == (drawn.arrived[b, t] == drawn.goal[b])
        goal = np.array(divmod(int(drawn.goal[b]), 10))
        for n in range(5):
            here = np.array(divmod(int(drawn.query[b, n]), 10))
            (action,) = np.flatnonzero(drawn.label[b, n])
            reached = np.abs(here + MOVES[action] - goal).sum()
            assert reached == max(0, np.abs(here - goal).sum() - 1), "the label does not lead to the goal"


def test_the_floor_equals_a_count_over_the_goals_consistent_with_the_context() -> None:
    data = quality.pretraining_data(0)
    assert isinstance(data, DPTData)
    drawn = data.draw(1, 0, 6, 1)
    total = 0.0
    for b in range(6):
        consistent = set(range(quality.GOALS))
        for t in range(quality.LENGTH):
            found = drawn.reward[b, t] > 0
            consistent = {m for m in consistent if (data.hypotheses.goal[m] == drawn.arrived[b, t]) == found}
            answers = [int(data.labels[m, drawn.query[b, 0]].argmax()) for m in consistent]
            total -= math.log(answers.count(int(drawn.label[b, 0].argmax())) / len(consistent))
    assert data.floor(drawn) == pytest.approx(total / (6 * quality.LENGTH), rel=1e-9)


def randomized(module: AnyModule) -> AnyModule:
    """The module with random parameters, none of them zero."""
    torch.manual_seed(0)
    with torch.no_grad():
        for parameter in module.parameters():
            parameter.copy_(torch.randn_like(parameter) * 0.3)
    return module


def test_the_peer_has_the_query_first_and_is_causal() -> None:
    model = randomized(peer.Peer(SPEC))
    context, query, _ = quality.tensors(quality.pretraining_data(0).draw(0, 0, 3, 1))
    with torch.no_grad():
        before = model(context, query)
        assert before.shape == (3, quality.LENGTH + 1, 5)
        for at in (0, 40, 99):
            rewards = context.rewards.clone()
            rewards[:, at] += 1
            moved = (model(context._replace(rewards=rewards), query) - before).abs().amax(dim=(0, 2))
            assert (moved[: at + 1] < 1e-6).all() and (moved[at + 1 :] > 1e-5).all()
        assert ((model(context, query + 1) - before).abs().amax(dim=(0, 2)) > 1e-5).all()
        swapped = Transitions(*(column.roll(1, dims=1) for column in context))
        assert (model(swapped, query) - before)[:, -1].abs().amax() > 1e-5, "positions have no effect"


def test_a_step_of_the_peer_uses_the_mean_loss_over_all_non_empty_prefixes() -> None:
    slow, fast = randomized(peer.Peer(SPEC)), randomized(peer.Peer(SPEC))
    context, query, label = quality.tensors(quality.pretraining_data(0).draw(0, 0, 2, 1))
    context = Transitions(*(column[:, :7] for column in context))
    total = torch.zeros(())
    for b in range(2):
        for length in range(1, 8):
            logits = slow(Transitions(*(c[b : b + 1, :length] for c in context)), query[b : b + 1])[0, -1]
            total = total - logits.log_softmax(-1)[label[b].argmax()]
    (total / 14).backward()
    before = {name: value.detach().clone() for name, value in fast.named_parameters()}
    peer.train_step(fast, torch.optim.SGD(fast.parameters(), lr=1.0), context, query, label)
    for (name, parameter), at in zip(fast.named_parameters(), slow.parameters(), strict=True):
        torch.testing.assert_close(before[name] - parameter, at.grad, atol=1e-5, rtol=1e-4)


@pytest.mark.integration
@torch.no_grad()
def test_both_held_out_losses_are_over_the_same_prefixes() -> None:
    drawn = quality.pretraining_data(0).draw(1, 0, 5, 1)
    context, query, label = quality.tensors(drawn)
    ours, theirs = randomized(PretrainedTransformer(SPEC, quality.MODEL)), randomized(peer.Peer(SPEC))
    slow = {"ours": 0.0, "theirs": 0.0}
    for b in range(5):
        for length in range(1, quality.LENGTH + 1):
            prefix = Transitions(*(c[b : b + 1, :length] for c in context))
            logits = ours.decide(query[b : b + 1, None], ours.encode(prefix))[0, 0], theirs(prefix, query[b : b + 1])[0, -1]
            for name, value in zip(slow, logits, strict=True):
                slow[name] -= float(value.log_softmax(-1)[label[b].argmax()]) / (5 * quality.LENGTH)
    assert quality._our_loss(ours, drawn) == pytest.approx(slow["ours"], rel=1e-4)
    assert quality._peer_loss(theirs, drawn) == pytest.approx(slow["theirs"], rel=1e-4)


@pytest.mark.parametrize("close", [-1.0, 10.0])
def test_a_training_ends_at_the_target_loss_or_at_its_limit(close: float, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(quality, "HELD_OUT", 4)
    monkeypatch.setattr(quality, "OPTIM", OptimConfig(batch=2, queries=3, warmup=1))
    monkeypatch.setattr(quality, "EVERY", 2)
    monkeypatch.setattr(quality, "PEER_EVERY", 2)
    messages: list[str] = []
    outcomes = quality.ours(0, messages.append, 3, close), quality.theirs(0, messages.append, 3 * peer.BATCH, close)
    evaluations = 1 if close > 0 else 2
    for result in outcomes:
        assert result["reached"] == (close > 0)
        assert len(result["curve"]) == evaluations and result["cpu_s"] == result["curve"][-1][0] >= 0
    assert outcomes[0]["floor"] == outcomes[1]["floor"] > 0
    assert [line.split(",")[0] for line in messages] == ["ours"] * evaluations + ["peer"] * evaluations


def test_costs_are_measured(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(cost, "LENGTHS", (0, 100, 200, 300))
    monkeypatch.setattr(cost, "OPTIM", OptimConfig(batch=2, queries=3))
    monkeypatch.setattr(peer, "BATCH", 2)
    deployed = cost.deployment(2, 1)
    assert min(deployed["ours"]) > 0 and len(deployed["ours"]) == 4 * len(deployed["peer"])
    assert min(cost.training(1).values()) > 0
    curve = cost.by_length(2)
    assert curve["length"] == [0, 100, 200, 300] and len(curve["decision_us"]) == 4 and math.isfinite(curve["length_exponent"])
    device = cost.on_device("cpu", 2, 3, 64)
    assert device["labels_share"] > 0 and device["decisions_share"] > 0 and device["device"] == "cpu"


def outcome(reached: bool, seconds: float) -> dict[str, Any]:
    return {"reached": reached, "cpu_s": seconds, "floor": 0.4, "curve": [(seconds / 2, 0.3), (seconds, 0.03)]}


@pytest.fixture
def measured(monkeypatch: pytest.MonkeyPatch) -> dict[str, Any]:
    """Fake measurements, which tests change."""
    values: dict[str, Any] = {
        "gflops": incontext.REFERENCE_GFLOPS,
        "deployment": {"ours": [30000.0, 40000.0, 50000.0], "peer": [2000.0]},
        "training": {"labels_per_s": 32000.0, "peer_labels_per_s": 800.0},
        "ours": [(True, 10.0), (True, 40.0), (True, 20.0)],
        "peer": [(True, 100.0), (True, 300.0), (True, 120.0)],
        "trained": [],
        "missed": [],
    }

    def train(side: str) -> Any:
        return lambda seed, report: values["trained"].append((side, seed)) or outcome(*values[side][seed])

    monkeypatch.setattr(cost, "matmul_gflops", lambda: values["gflops"])
    monkeypatch.setattr(cost, "deployment", lambda batch, pairs: values["deployment"])
    monkeypatch.setattr(cost, "training", lambda rounds: values["training"])
    monkeypatch.setattr(cost, "by_length", lambda: {"length": [0, 4000], "decision_us": [300, 9000], "length_exponent": 0.9})
    monkeypatch.setattr(decoder, "run", lambda quick, report: {"kernel": None, "decoder_missed": values["missed"]})
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    monkeypatch.setattr(quality, "ours", train("ours"))
    monkeypatch.setattr(quality, "theirs", train("peer"))
    return values


def test_ratios_are_computed_from_medians(measured: dict[str, Any], tmp_path: Path) -> None:
    threads = torch.get_num_threads()
    result = incontext.run(tmp_path)
    assert torch.get_num_threads() == threads
    assert result["deploy_ratio_20"] == result["deploy_ratio_512"] == 20.0 and result["labels_ratio"] == 40.0
    assert (result["time_to_quality_ratio"], result["time_to_quality_is_a_bound"]) == (6.0, False)
    assert (result["ok"], result["reasons"], result["gpu"]) == (True, [], None)
    assert Path(result["figure"]).stat().st_size > 10_000
    assert json.loads(json.dumps(result)) == result
    assert "   40,000     2,000    20.0" in incontext.describe(result)


def test_a_peer_below_its_floors_fails_and_a_slow_machine_lowers_the_floors(measured: dict[str, Any], tmp_path: Path) -> None:
    measured["training"]["peer_labels_per_s"], measured["deployment"]["peer"] = 590.0, [1090.0]
    result = incontext.run(tmp_path, quick=True)
    assert not result["ok"] and len(result["reasons"]) == 2
    assert "the peer's training is 590/s, below 600" in result["reasons"][0] and "1090/s, below 1100" in result["reasons"][1]
    assert result["reasons"][0] in incontext.describe(result)
    measured["gflops"] = 0.9 * incontext.REFERENCE_GFLOPS
    assert incontext.run(tmp_path, quick=True)["ok"]
    measured["missed"] = ["the kernel is slow"]
    assert incontext.run(tmp_path, quick=True)["reasons"] == ["the kernel is slow"]
    measured["missed"] = []
    measured["gflops"] = 9 * incontext.REFERENCE_GFLOPS
    assert incontext.run(tmp_path, quick=True)["floor_scale"] == 1.0


def test_a_stopped_peer_gives_a_bound_and_without_our_target_loss_there_is_no_ratio(
    measured: dict[str, Any], tmp_path: Path
) -> None:
    measured["peer"][0] = (False, 500.0)
    result = incontext.run(tmp_path / "bound", quick=True)
    assert (result["time_to_quality_ratio"], result["time_to_quality_is_a_bound"], result["ok"]) == (50.0, True, True)
    assert "lower bounds" in incontext.describe(result)
    measured["ours"][0] = (False, 10.0)
    result = incontext.run(tmp_path / "nothing", quick=True)
    assert (result["time_to_quality_ratio"], result["ok"]) == (None, False)
    assert "did not reach a loss within" in incontext.describe(result)


def test_finished_trainings_are_reused_for_the_same_settings_only(
    measured: dict[str, Any], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    first = incontext.run(tmp_path, quick=True)
    assert measured["trained"] == [("ours", 0), ("peer", 0)]
    measured["trained"].clear()
    assert incontext.run(tmp_path, quick=True) == first
    assert measured["trained"] == []
    incontext.run(tmp_path)
    assert measured["trained"] == [(side, seed) for seed in (1, 2) for side in ("ours", "peer")]
    measured["trained"].clear()
    monkeypatch.setattr(quality, "CLOSE", 0.02)
    incontext.run(tmp_path, quick=True)
    assert measured["trained"] == [("ours", 0), ("peer", 0)]


def test_cells_become_coordinates() -> None:
    drawn = quality.pretraining_data(0).draw(0, 0, 2, 1)
    assert isinstance(drawn, DPTContexts)
    data = drawn.batch(np.ones((2, 1), np.int64))
    assert (data.observations == cells(10)[drawn.cell]).all() and (data.next_observations == cells(10)[drawn.arrived]).all()


def test_seconds_are_refused(capsys: pytest.CaptureFixture[str]) -> None:
    assert main.main(["bench", "incontext", "--seconds", "3"]) == 2
    assert "this benchmark has a fixed size" in capsys.readouterr().err
