"""Experts below the return that a run asks for are named, and end the run, before labels are made of them."""

import dataclasses
from typing import Any

import pytest

import icrl_dist
from icrl_dist.config.run import ConfigError
from icrl_dist.experts import standing, train
from icrl_dist.experts.standing import Standing
from icrl_dist.interfaces import EndsRun
from icrl_dist.launch import expert_checks
from icrl_dist.launch.learner_process import TrainFailed
from icrl_dist.problems import registry
from icrl_dist.results import run_experts
from icrl_dist.storage.dataset import Dataset
from icrl_dist.types import NULL
from tests.calls import failing
from tests.experts.histories import HORIZON, run, trained
from tests.experts.sac_cases import LINE
from tests.jobs import do, in_problem, jobs_of
from tests.optional import known

__all__ = ["run", "trained"]

NEVER = 10.0 * HORIZON
"""A return that no expert reaches."""


def asking(run, **settings):
    return dataclasses.replace(run, sac=dataclasses.replace(run.sac, **settings))


def test_the_list_names_the_share_and_the_worst_experts_first():
    standings = [Standing(f"task{n}-variation0", 100.0 - n, 95.0) for n in range(20)] + [Standing("free", 0.0, 0.0)]
    text = standing.listed(standings)
    assert text.startswith("14 of 21 experts (67%) return less than sac.least_return")
    assert text.endswith("task12-variation0 (88 of 95) and 6 more")
    assert "asks for: task19-variation0 (81 of 95), task18-variation0 (82 of 95), " in text
    assert not standing.listed(standings[:6]) and not standing.listed([])
    assert standing.listed([Standing("lost", float("nan"), 1.0)]) and standing.listed([Standing("cost", -5.0, -4.0)])
    with pytest.raises(EndsRun, match=r"no label was made of them; .*--sac.failed-experts teach$"):
        standing.require(standings)


@pytest.mark.integration
def test_undisturbed_and_disturbed_experts_are_asked_for_returns_of_their_own(run, monkeypatch):
    job = jobs_of(asking(run, least_return=NEVER))[0]
    with pytest.raises(EndsRun, match=r"2 of 4 experts \(50%\) .*: task[01]-variation0 \(.* of 200\), task[01]-variation0"):
        do(run, job)
    job = jobs_of(asking(run, least_return_disturbed=NEVER))[0]
    with pytest.raises(EndsRun, match=r": task[01]-variation1 \(.*, task[01]-variation1 \("):
        do(run, job)
    monkeypatch.setattr(train, "history_trajectories", failing(AssertionError("a label was made")))
    with pytest.raises(EndsRun):
        list(do(run, job))
    monkeypatch.undo()
    notes, job = list[str](), jobs_of(asking(run, least_return=NEVER, failed_experts="teach"))[0]
    assert len(do(run, job, progress=lambda text, note=False, **_: notes.extend([text] * note))) == 4 * 3
    assert "labels are made although 2 of 4 experts" in notes[-1]


@pytest.mark.integration
def test_the_returns_are_those_of_the_expert_after_its_training(run):
    job = jobs_of(run)[0]
    do(run, job)
    (mine, *_), *_ = run_experts.wanted(run)
    history = known(mine.load())
    assert standing.earned(history) == pytest.approx(history.window_rewards.sum() / 8)
    assert [one.earned for one in run_experts.standings(asking(run, least_return=NEVER), [[mine]])] == [
        standing.earned(history)
    ]
    assert run_experts.standings(run, [[mine]]) == [], "nothing is asked for"


@pytest.mark.integration
def test_a_run_ends_with_the_list_and_goes_on_where_the_flag_says_so(run, trained, tmp_path):
    few = dataclasses.replace(run, method="dpt", pretrain=dataclasses.replace(run.pretrain, contexts=4 * 3, steps=2))
    few = dataclasses.replace(few, evaluate=dataclasses.replace(few.evaluate, episodes=1, seeds=1, p=(0.0,)))
    asked, folder, events = asking(few, least_return=NEVER), tmp_path / "run", list[dict[str, Any]]()
    with pytest.raises(TrainFailed, match=r"pretrain/0/0.*: 2 of 2 experts \(100%\) .* --sac.failed-experts teach"):
        icrl_dist.train(asked, folder, engine="inline", progress=events.append)
    data = Dataset(folder / "dataset", readonly=True)
    assert len(data) == 0 and trained[0] == 2, "the first job trained its experts, and no label was stored"
    data.close()
    assert any(
        "a worker trains up to 2 SAC experts of 2x8 at once and needs about 0.5 GB" in str(e.get("text")) for e in events
    )
    count = len(trained)
    with pytest.raises(ConfigError, match=r"of \d experts \(100%\).*no label was made of them"):
        icrl_dist.train(asked, tmp_path / "again", engine="inline")
    assert not (tmp_path / "again").exists() and len(trained) == count, "found before the start, in the cache"
    going_on = asking(few, least_return=NEVER, failed_experts="teach")
    events.clear()
    made = icrl_dist.train(going_on, folder, engine="inline", resume=True, progress=events.append)
    texts = [str(event.get("text")) for event in events]
    assert made.result["trajectories"] == 12 and any("labels are made although" in text for text in texts)
    assert made.result["dataset_digest"] == icrl_dist.train(few, tmp_path / "plain", engine="inline").result["dataset_digest"]
    experts = icrl_dist.train(dataclasses.replace(asked, method="experts"), tmp_path / "experts-run", engine="inline")
    assert any(
        "4 of 8 experts (50%)" in note and "a method that trains refuses them" in note for note in experts.evaluation.notes
    )


@pytest.mark.integration
def test_a_scripted_policy_labels_whatever_the_experts_earn(run, monkeypatch):
    assert standing.labels_come_from_experts(registry.of(run))
    arm = in_problem(run, "metaworld-pick-place", sac=dataclasses.replace(LINE, least_return=NEVER, cache=""))
    assert not standing.labels_come_from_experts(registry.of(arm))
    assert run_experts.standings(arm, run_experts.wanted(arm)) == []


@pytest.mark.integration
def test_a_run_without_experts_or_with_all_of_them_says_nothing_about_them(run, small_run):
    assert list(expert_checks.notes(small_run)) == []
    assert len(list(expert_checks.notes(run))) == 1
    for job in jobs_of(run):
        do(run, job)
    assert list(expert_checks.notes(run)) == []


def test_a_variation_without_adversary_is_the_undisturbed_one(run):
    null, pushed = jobs_of(run)[0].variations[:2]
    sac = dataclasses.replace(run.sac, least_return=3.0, least_return_disturbed=2.0)
    assert null.adversary == NULL != pushed.adversary
    assert (standing.least(sac, null), standing.least(sac, pushed)) == (3.0, 2.0)
