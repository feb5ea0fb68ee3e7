"""Rows of episodes that a training collected itself."""

from __future__ import annotations

import dataclasses
import json
from itertools import groupby

import numpy as np
import pytest

from icrl_dist import read_results
from icrl_dist.methods import registry as methods
from icrl_dist.results import rows, summaries, training_rows
from tests.jobs import FixedWeights, InMemoryDataset, collect


def trials_of(run, phase, weights):
    """The trajectories of a phase by variation."""
    found = sorted(collect(run, phase, weights), key=lambda trajectory: trajectory.identity.key())
    return [list(group) for _, group in groupby(found, key=lambda trajectory: trajectory.identity[:4])]


def test_the_first_and_the_last_episode_of_each_expert_are_in_the_table(small_run, tmp_path):
    variations = trials_of(small_run, methods.of(small_run).phases(small_run)[1], FixedWeights(small_run))
    rows.append(tmp_path / "results", "experts", {}, [training_rows.of_expert(small_run, "run", one) for one in variations])
    frame = read_results(tmp_path)
    assert len(frame) == sum(map(len, variations)) and set(frame.agent) == {"expert"} and frame.p.isna().all()
    shown = summaries.experts(frame.sample(frac=1, random_state=0))  # the order of rows does not matter
    assert shown == [
        {
            "task": {name: value for name, value in one[0].variation.task.params if isinstance(value, float)},
            "adversary": one[0].variation.adversary.kind,
            "returns": [round(trial.episode_return, 2) for trial in (one[0], one[-1])],
        }
        for one in variations
    ]


def test_a_round_that_a_resumed_run_rates_again_is_read_once(small_run, tmp_path):
    method, weights = methods.of(small_run), FixedWeights(small_run)
    phase = method.phases(small_run)[1]
    trajectories = [trial for one in trials_of(small_run, phase, weights) for trial in one]
    data = InMemoryDataset(trajectories)
    found = [
        training_rows.rate_labels(small_run, tmp_path, phase, method.label_quality(small_run, phase, data), pytest.fail)
        for _ in range(2)
    ]
    assert found[0] == found[1] is not None and len(list((tmp_path / "results").iterdir())) == 2
    frame = read_results(tmp_path)
    by_key = {(row["task_index"], row["adversary_index"], row["episode"]): row for row in frame.to_dict("records")}
    assert len(frame) == len(by_key) == len(trajectories)
    for trial in trajectories:
        row = by_key[trial.identity.task, trial.identity.variation, trial.identity.trial]
        assert row["return"] == trial.episode_return and row["agent"] == f"t{trial.policy_version}"
        context = trial.identity.trial <= small_run.icaa.context_trials
        assert row["data"] == ("context" if context else "labels")
        assert row["weights_digest"] == trial.weights_digest and row["tasks"] == "train"
        assert row["adversary_family"] == trial.variation.adversary.kind
        assert tuple(json.loads(row["task"])["goal"]) == trial.variation.task.vector("goal")


@pytest.mark.parametrize("fault", ["disk", "nan"])
def test_rows_that_cannot_be_written_end_no_training(small_run, tmp_path, monkeypatch, fault):
    method = methods.of(small_run)
    notes: list[str] = []
    phase = method.phases(small_run)[1]
    trajectories = [trial for one in trials_of(small_run, phase, FixedWeights(small_run)) for trial in one]
    rated = list(method.label_quality(small_run, phase, InMemoryDataset(trajectories)))
    if fault == "disk":
        (tmp_path / "results").touch()  # no folder can be made here
    else:
        trial = dataclasses.replace(trajectories[0], rewards=trajectories[0].rewards * np.nan)
        rated[0] = rated[0]._replace(trials=[trial, *rated[0].trials[1:]])
    assert training_rows.rate_labels(small_run, tmp_path, phase, rated, notes.append) is None
    (note,) = notes
    assert note.startswith("round 0: its label quality is not stored, and training goes on: ") and "\n" not in note


def test_a_round_without_labels_of_the_model_writes_nothing(small_run, tmp_path):
    method = methods.of(small_run)
    pretrain = method.phases(small_run)[0]
    rated = method.label_quality(small_run, pretrain, InMemoryDataset([]))
    assert training_rows.rate_labels(small_run, tmp_path, pretrain, rated, pytest.fail) is None
    assert not list(tmp_path.iterdir())
