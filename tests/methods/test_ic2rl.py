"""In-context robust RL: DPT's contexts with the labels of robust policies."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest

from icrl_dist.config.run import ConfigError, Run, load_run, override
from icrl_dist.config.sections import AdversaryConfig
from icrl_dist.launch.whole_run import train
from icrl_dist.methods import budget
from icrl_dist.methods import registry as methods
from icrl_dist.problems.darkroom.solver import Hypotheses, cell_numbers, robust_labels
from icrl_dist.stream import wire
from icrl_dist.types import NULL, Variation
from tests.jobs import collect, decoded


@pytest.fixture
def room_run(small_run: Run) -> Run:
    """A room whose worst adversary changes labels, with action windows."""
    return dataclasses.replace(
        small_run,
        method="ic2rl",
        adversary=AdversaryConfig(count=2, p_max=0.6),
        model=dataclasses.replace(small_run.model, window=3),
        pretrain=dataclasses.replace(small_run.pretrain, windows=1, decoy_fraction=0.0, queries=9),
        optim=dataclasses.replace(small_run.optim, windows=1),
    )


def test_contexts_are_dpts_and_labels_are_those_of_the_robust_policy(room_run: Run) -> None:
    dpt, room = dataclasses.replace(room_run, method="dpt"), room_run.section("darkroom")
    (phase,) = methods.of(room_run).phases(room_run)
    assert (phase,) == methods.of(dpt).phases(dpt)
    jobs = methods.of(room_run).ask(room_run, phase)
    assert [decoded(room_run, wire.encode_job(job)) for job in jobs] == list(jobs), "a worker gets another job"
    made, theirs = (sorted(collect(run, phase), key=lambda t: t.identity) for run in (room_run, dpt))
    differing = 0
    for t, other in zip(made, theirs, strict=True):
        assert (t.identity, t.variation, t.origin) == (other.identity, Variation(t.variation.task, NULL), "optimal")
        for name in ("observations", "actions", "rewards", "adversary"):
            np.testing.assert_array_equal(getattr(t, name), getattr(other, name))
        np.testing.assert_array_equal(t.queries[:9], other.queries[:9])
        table = robust_labels(Hypotheses.of([t.variation]), 0.6, room.gamma, room.label_slack)[0]
        np.testing.assert_array_equal(t.labels, table[cell_numbers(t.queries, 3)])
        differing += int((t.labels[:9] != other.labels[:9]).any())
    assert differing, "no label differs from the optimum's, so the test shows nothing"


def test_its_budget_is_dpts_and_names_the_labels(room_run: Run) -> None:
    ours, dpts = budget.of(room_run), budget.of(dataclasses.replace(room_run, method="dpt"))
    assert ours == dpts._replace(label_source="robust optimal")


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        (
            ("darkroom.disturbance=wind",),
            "darkroom.disturbance = 'wind': robust policies are known for 'override' only: use it",
        ),
        (("darkroom.labels=heuristic",), "darkroom.labels = 'heuristic': robust policies are exact: use 'soft' or 'sampled'"),
    ],
)
def test_settings_without_robust_policies_are_refused_with_the_remedy(settings: tuple[str, ...], message: str) -> None:
    with pytest.raises(ConfigError) as caught:
        load_run("darkroom-7x7", "method=ic2rl", *settings)
    assert str(caught.value) == f"darkroom-7x7: method = 'ic2rl': {message}"


def test_a_problem_without_a_second_player_and_dagger_rounds_are_refused(room_run: Run) -> None:
    with pytest.raises(
        ConfigError, match=r"^metaworld-laptop: method = 'ic2rl': metaworld-pick-place has no second player.*use dpt"
    ):
        load_run("metaworld-laptop", "method=ic2rl")
    with pytest.raises(ConfigError, match=r"^x: dagger.rounds = 1: ic2rl has no such rounds: use 0$"):
        override(room_run, ["dagger.rounds=1"], "x")


@pytest.mark.integration
def test_a_packaged_run_trains_and_evaluates_with_it(tmp_path: Path) -> None:
    tiny = ("pretrain.contexts=90", "pretrain.steps=4", "evaluate.episodes=2", "evaluate.seeds=1", "evaluate.p=[0.0]")
    run = load_run("darkroom-7x7", "method=ic2rl", *tiny, "optim.batch=4", "model.width=16", "model.layers=1")
    trained = train(run, tmp_path / "run", engine="inline")
    rows = trained.evaluation.rows
    assert set(rows["method"]) == {"ic2rl"} and set(rows["label_source"]) == {"robust optimal"}
    assert {"t0", "random", "oracle"} <= set(rows["agent"]) and np.isfinite(rows["return"]).all()
