"""What a training costs, against counting in the data and batches of the training itself."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from icrl_dist.config.run import Run, load, override
from icrl_dist.config.sections import DAggerConfig
from icrl_dist.experts.payloads import WINDOW_EPISODES
from icrl_dist.methods import budget, examples
from icrl_dist.methods import registry as methods
from icrl_dist.problems import registry as problems
from icrl_dist.results import evaluate
from icrl_dist.results.columns import COLUMNS
from icrl_dist.storage.dataset import Dataset
from icrl_dist.training import batches
from tests.calls import keeping
from tests.learner.test_service import no_tensorboard, run_inline

__all__ = ["no_tensorboard"]


def windowed(run: Run) -> Run:
    return dataclasses.replace(
        run,
        model=dataclasses.replace(run.model, window=3),
        pretrain=dataclasses.replace(run.pretrain, windows=2),
        optim=dataclasses.replace(run.optim, windows=1),
    )


CASES: dict[str, tuple[str, dict[str, Any], str]] = {
    "dpt": ("dpt", {}, "optimal"),
    "icag with rounds": ("icag", {"dagger": DAggerConfig(rounds=1, trials=3, steps=4)}, "optimal"),
    "mix_dpt": ("mix_dpt", {}, "optimal"),
    "dr": ("dr", {}, "undisturbed optimal"),
    "ic2rl": ("ic2rl", {}, "robust optimal"),
    "icaa": ("icaa", {}, "optimal, own actions"),
    "icaa, the better half": ("icaa", {"label_trials": "top_return"}, "optimal, own actions"),
    "icag with windows": ("icag", {"windows": True}, "optimal"),
}


def case(name: str, run: Run) -> tuple[Run, str]:
    method, changes, source = CASES[name]
    run = override(dataclasses.replace(run, method=method), ["mix_dpt.rounds=2", "mix_dpt.trials=2"], "x")
    if "dagger" in changes:
        run = dataclasses.replace(run, dagger=changes["dagger"])
    if "label_trials" in changes:
        run = dataclasses.replace(run, icaa=dataclasses.replace(run.icaa, label_trials=changes["label_trials"]))
    return (windowed(run) if changes.get("windows") else run), source


@pytest.mark.integration
@pytest.mark.parametrize("name", CASES)
def test_a_budget_is_what_the_training_takes(
    small_run: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str
) -> None:
    run, source = case(name, small_run)
    expected = budget.of(run)
    drawn: list[batches.TrainingBatch] = []
    monkeypatch.setattr(batches, "draw", keeping(drawn, batches.draw))
    result = run_inline(run, tmp_path / "run")
    store = Dataset(tmp_path / "run" / "dataset", readonly=True)
    trajectories = [store.read(row.identity) for row in store.index]
    store.close()
    episodes, steps, labelled = 0, 0, 0
    labels = label_bytes = sent = 0
    of_variation: dict[tuple[str, int, int, int], list[Any]] = {}
    for t in trajectories:
        arrays = t.arrays()
        sent += sum(array.nbytes for array in arrays.values())
        labels += len(t.labels)
        label_bytes += sum(arrays[name].nbytes for name in ("queries", "labels", "prev_actions", "prev_rewards"))
        episodes += 1
        steps += len(t.actions) + len(t.prev_actions)
        labelled += bool(len(t.labels))
        of_variation.setdefault(t.identity[:4], []).append(t)
    for trials in of_variation.values():
        if trials[0].origin == "none":
            made = examples.self_labelled(run, sorted(trials, key=lambda t: t.identity.trial))
            labelled += 0 if made is None else len(made.queries) // len(trials[0].actions)
            labels += 0 if made is None else len(made.queries)
            label_bytes += 0 if made is None else len(made.queries) * (trials[0].observations[0].nbytes + 2)
    assert result["trajectories"] == episodes
    assert budget.label_bytes(run) == (labels, label_bytes, sent)
    assert expected == (source, episodes, labelled, steps, len(drawn), sum(len(one.observations) for one in drawn), 0)


def test_bytes_of_labels_of_vectors_are_not_known() -> None:
    assert budget.label_bytes(load("metaworld-laptop")) is None


def test_improved_trials_are_counted_as_at_most_all_later_ones(small_run: Run) -> None:
    later, improved = (
        budget.of(dataclasses.replace(small_run, icaa=dataclasses.replace(small_run.icaa, label_trials=name)))
        for name in ("later", "improved")
    )
    assert improved == later


def test_labels_that_compare_actions_are_made_from_all_trials(small_run: Run) -> None:
    later, compared = (
        budget.of(dataclasses.replace(small_run, icaa=dataclasses.replace(small_run.icaa, labels=name)))
        for name in ("actions", "transitions")
    )
    assert compared.labelled_episodes == compared.training_episodes
    assert later.labelled_episodes is not None and later.labelled_episodes < compared.training_episodes
    assert compared.label_source == "optimal, own transitions"


def test_demonstrations_of_experts_count_with_their_training() -> None:
    """Every expert's training in whole episodes, its window episodes, and those of the decoys."""
    windows = ["model.window=5", "pretrain.windows=2", "optim.windows=1"]
    run = override(load("dmc-cartpole-balance-laptop"), windows, "x")
    method = methods.of(run)
    jobs = method.ask(run, method.phases(run)[0])
    horizon, experts = problems.of(run).horizon, sum(len(job.variations) for job in jobs)
    episodes = sum(job.trials * len(job.variations) for job in jobs)
    found = budget.of(run)
    own = run.sac.steps // horizon + WINDOW_EPISODES
    assert run.pretrain.decoy_fraction
    assert found.environment_steps == experts * (own + WINDOW_EPISODES) * horizon
    assert (found.label_source, found.training_episodes, found.labelled_episodes) == ("expert", episodes, episodes)
    alone = override(run, ["pretrain.windows=0", "optim.windows=0", "model.window=1"], "x")
    assert budget.of(alone).environment_steps == experts * own * horizon
    scripted = load("metaworld-laptop")
    found, section = budget.of(scripted), scripted.section("control")
    variations = section.train_tasks * scripted.adversary.variations
    more = WINDOW_EPISODES * (1 + (scripted.pretrain.decoy_fraction > 0)) if scripted.pretrain.windows else 0
    assert section.histories == "scripted"
    assert found.environment_steps == (found.training_episodes + variations * more) * problems.of(scripted).horizon


def test_result_rows_hold_the_budget(small_run: Run) -> None:
    columns, found = evaluate.of_run(small_run, "run"), budget.of(small_run)
    names = ("label_source", "training_episodes", "labelled_episodes", "environment_steps", "optimizer_steps")
    assert set(names) <= set(COLUMNS) and [columns[name] for name in names] == list(found[:5])


def test_a_method_whose_jobs_do_not_say_what_they_label_has_no_known_number_of_labels(
    small_run: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    run = dataclasses.replace(small_run, method="dpt", seed=12345)
    monkeypatch.setattr(type(methods.of(run)), "used_labels", lambda self, run, phase, job: None)
    found = budget.of(run)
    assert (found.label_source, found.labelled_episodes, found.training_episodes) == (None, None, 42)


def with_split(run: Run, seed: int, split: int) -> Run:
    return override(run, [f"seed={seed}", f"darkroom.split_seed={split}"], "x")


def test_differences_name_what_makes_a_comparison_unfair(small_run: Run) -> None:
    dpt, icag = ([with_split(dataclasses.replace(small_run, method=m), s, 10 + s) for s in (0, 1)] for m in ("dpt", "icag"))
    assert budget.differences({"dpt": dpt, "icag": icag[::-1]}) == []
    assert budget.differences({"dpt": dpt, "icag": icag[:1]}) == [
        "seeds differ: dpt: 0, 1; icag: 0",
        "splits differ: dpt: 10, 11; icag: 10",
    ]
    crossed = [with_split(icag[0], 0, 11), with_split(icag[0], 1, 10)]
    assert budget.differences({"dpt": dpt, "icag": crossed}) == [
        "splits differ for the same seed: give all methods the same pairs of seed and split_seed"
    ]
    more = [override(run, ["pretrain.contexts=84", "pretrain.steps=2000"], "x") for run in icag]
    assert budget.differences({"dpt": dpt, "icag": icag, "big": more}) == [
        "environment steps differ: dpt, icag: 336; big: 672",
        "labelled episodes differ: dpt, icag: 42; big: 84",
        "optimizer steps differ: dpt, icag: 10; big: 2,000",
    ]
    assert budget.differences({"dpt": dpt, "none": []})[0] == "seeds differ: dpt: 0, 1; none: no training"


def test_differences_are_found_in_result_rows_too(small_run: Run) -> None:
    dpt, icaa = (dataclasses.replace(small_run, method=name) for name in ("dpt", "icaa"))
    rows = {name: [evaluate.of_run(run, name)] for name, run in (("dpt", dpt), ("icaa", icaa))}
    assert budget.differences(rows) == budget.differences({"dpt": [dpt], "icaa": [icaa]}) != []
    unknown = {**rows["dpt"][0], "labelled_episodes": None}
    assert budget.differences({"a": rows["dpt"], "b": [unknown]}) == ["labelled episodes differ: a: 42; b: not known"]
    assert np.int64(0) == budget.split_seed(dpt)
