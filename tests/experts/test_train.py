"""Histories of SAC experts: what is delivered, what the cache keeps, and the cost of a kill or a diverged simulation."""

import dataclasses
import errno
import pwd

import numpy as np
import pytest

from icrl_dist.experts import cache, train
from icrl_dist.experts.payloads import ExpertHistories
from icrl_dist.experts.sac import batched
from icrl_dist.experts.train import ExpertPolicy
from icrl_dist.methods.examples import self_labelled
from icrl_dist.problems import registry
from icrl_dist.problems.continuous.network_adversary import Networks
from icrl_dist.problems.continuous.problem import EXPERT
from icrl_dist.problems.dmc.problem import DMCProblem
from icrl_dist.results import evaluate, summaries
from icrl_dist.storage.checkpoint import save_checkpoint
from icrl_dist.storage.files import unwritten
from icrl_dist.stream import wire
from icrl_dist.types import NULL
from tests.calls import failing
from tests.experts.histories import EPISODES, HORIZON, Breaking, KilledError, digests, run, trained
from tests.jobs import FixedWeights, decoded, do, jobs_of
from tests.optional import known
from tests.results.row_blocks import frame

pytestmark = pytest.mark.integration

__all__ = ["run", "trained"]


def test_a_job_has_all_variations_of_a_few_tasks_and_the_section_sac(run):
    first, second = jobs_of(run)
    assert first.kind == "train_expert" and (first.trials, first.tasks, second.task) == (3, 2, 2)
    assert [v.adversary == NULL for v in first.variations] == [True, False] * 2
    assert isinstance(first.payload, ExpertHistories)
    assert first.payload.sac == run.sac and decoded(run, wire.encode_job(first)) == first
    assert {v.adversary for job in jobs_of(run, "dpt") for v in job.variations} == {NULL}


def test_contexts_are_episodes_of_the_training_and_labels_are_actions_of_its_expert(run):
    job = jobs_of(run)[0]
    sent = do(run, job)
    assert [t.identity for t in sent] == list(job.identities())
    found = [known(cache.load_any(v, HORIZON, run.sac, run.seed)) for v in job.variations]
    for t in sent:
        row = job.variations.index(t.variation)
        history = found[row]
        assert history.rewards.shape == (EPISODES, HORIZON) and t.origin == "expert" and t.policy_version == -1
        number = [0, 4, 9][t.identity.trial]  # evenly spaced, from the first random one to the last
        for name in ("observations", "actions", "rewards", "adversary"):
            np.testing.assert_array_equal(getattr(t, name), getattr(history, name)[number])
        states = history.observations[:, :-1].reshape(-1, 6)
        assert all((states == query).all(axis=1).any() for query in t.queries) and len(t.queries) == 6
        policy = ExpertPolicy([history] * 6, run.sac)
        np.testing.assert_allclose(t.labels, policy.act(t.queries, np.zeros((6, 2))), atol=1e-5)
        pushes = Networks([t.variation.adversary] * HORIZON, registry.spec(t.variation.task), 2).act(t.observations[:-1])
        np.testing.assert_allclose(t.adversary, pushes, atol=1e-6)
    assert np.abs(sent[-1].adversary).max() > 0.1 and not sent[0].adversary.any()
    assert len({t.queries.tobytes() for t in sent}) == len(sent)


def test_the_same_job_gives_the_same_bytes_with_or_without_a_cache(run, tmp_path):
    job = jobs_of(run)[0]
    here = digests(do(run, job, worker="w0"))
    assert digests(do(run, job, worker="w1")) == here, "from the cache"
    none = dataclasses.replace(run, sac=dataclasses.replace(run.sac, cache=""))
    assert digests(do(run, jobs_of(none)[0])) == here, "without one"
    other = dataclasses.replace(none, seed=1)
    assert digests(do(run, jobs_of(other)[0])) != here


def test_nothing_is_trained_that_is_in_the_cache(run, trained, caplog):
    job = jobs_of(run)[0]
    first = digests(do(run, job))
    assert trained == [4]
    assert digests(do(run, dataclasses.replace(job, trials=2))) != first and trained == [4]
    file = cache.file(run.sac, cache.key(job.variations[2], HORIZON, run.sac, run.seed, "lockstep"))
    whole = file.read_bytes()
    for damage in (whole[: len(whole) // 2], b"nothing"):
        file.write_bytes(damage)
        assert digests(do(run, job)) == first
    assert trained == [4, 1, 1] and "is made again" in caplog.text and file.read_bytes() == whole


@pytest.mark.parametrize("broken", ["a file", "no home", "disk full at the end"])
def test_experts_are_trained_once_and_delivered_where_the_cache_cannot_be_used(run, trained, tmp_path, monkeypatch, broken):
    job = jobs_of(run)[0]
    expected = digests(do(run, job))
    notes, place = list[str](), str(tmp_path / "file" / "experts")
    if broken == "a file":
        (tmp_path / "file").write_text("")
    elif broken == "no home":
        place = "~/.cache/icrl-dist/experts"
        monkeypatch.delenv("HOME")
        monkeypatch.setattr(pwd, "getpwuid", failing(KeyError("uid not found: 12345")))
    else:
        full = OSError(errno.ENOSPC, "No space left on device")
        monkeypatch.setattr(cache, "save_checkpoint", failing(unwritten(tmp_path / "x.npz", full)))
    monkeypatch.setattr(train, "_reported", set())
    other = jobs_of(dataclasses.replace(run, sac=dataclasses.replace(run.sac, cache=place)))

    def progress(text, note=False, reached=0):
        notes.extend([text] * note)

    made = [digests(do(run, one, progress=progress)) for one in other]
    assert made[0] == expected and trained == [4, 4, 4], "each job trained its experts once"
    (note,) = notes
    assert note.startswith("experts are not stored: ") and ("set HOME" if broken == "no home" else str(tmp_path)) in note


def test_a_cache_that_cannot_be_written_is_found_before_the_training(run, tmp_path, monkeypatch):
    (tmp_path / "file").write_text("")
    sac = dataclasses.replace(run.sac, cache=str(tmp_path / "file"))
    events = list[str]()
    monkeypatch.setattr(train, "_reported", set())
    monkeypatch.setattr(batched, "train", failing(KilledError))
    with pytest.raises(KilledError):
        do(run, jobs_of(dataclasses.replace(run, sac=sac))[0], progress=lambda text, **_: events.append(text))
    assert "set sac.cache to a folder that you may write to" in events[0]


def test_a_method_takes_the_experts_that_another_method_trained_and_ends_with_the_same_bytes(run, trained, tmp_path):
    """DPT needs the undisturbed ones of ICAG's experts, which train with other experts."""
    other_cache = dataclasses.replace(run, sac=dataclasses.replace(run.sac, cache=str(tmp_path / "other")))
    own = [digests(do(run, job)) for job in jobs_of(other_cache, "dpt")]
    assert trained == [2, 2]
    for job in jobs_of(run, "icag"):
        do(run, job)
    assert trained == [2, 2, 4, 4]
    assert [digests(do(run, job)) for job in jobs_of(run, "dpt")] == own and trained == [2, 2, 4, 4]


def test_a_history_delivers_at_most_the_episodes_of_its_training_and_keeps_all_of_them_if_all_are_needed(run, monkeypatch):
    monkeypatch.setattr(cache, "RECORDED_EPISODES", 6)
    many = dataclasses.replace(run, pretrain=dataclasses.replace(run.pretrain, contexts=8 * 30))
    job = jobs_of(many)[0]
    assert job.trials == EPISODES
    sent = do(run, job)
    assert len({t.actions.tobytes() for t in sent}) == len(sent) == 4 * EPISODES
    few = jobs_of(run)[0]
    assert few.trials == 3
    do(run, few)
    assert len(known(cache.load(few.variations[0], HORIZON, run.sac, run.seed, "lockstep")).rewards) == 6


def test_a_killed_training_continues_from_its_checkpoint_to_the_same_bytes(run, monkeypatch):
    job = jobs_of(run)[0]
    undisturbed = digests(do(run, jobs_of(dataclasses.replace(run, sac=dataclasses.replace(run.sac, cache="")))[0]))
    monkeypatch.setattr(train, "CHECKPOINT_S", 0.0)
    begun = list[str]()

    def killed(path, checkpoint):
        save_checkpoint(path, checkpoint)
        begun.append(path.name)
        if len(begun) in (4, 7):
            raise KilledError

    monkeypatch.setattr(train, "save_checkpoint", killed)
    for _ in range(2):
        with pytest.raises(KilledError):
            do(run, job)
    assert all(name.startswith("part-") for name in begun) and len(begun) == 7
    assert digests(do(run, job)) == undisturbed
    assert len([name for name in begun if name.startswith("part-")]) == EPISODES, "no episode was trained twice"
    assert not list(cache.file(run.sac, "").parent.glob("part-*"))


@pytest.mark.parametrize("always", [False, True])
def test_episodes_that_diverged_are_left_out(run, monkeypatch, always):
    real = DMCProblem.batch
    monkeypatch.setattr(DMCProblem, "batch", lambda problem, variations: Breaking(real(problem, variations), always))
    job = jobs_of(run)[0]
    if always:
        with pytest.raises(RuntimeError, match="diverges in every episode"):
            do(run, job)
        return
    do(run, job)
    lengths = [len(known(cache.load_any(v, HORIZON, run.sac, run.seed)).rewards) for v in job.variations]
    assert lengths == [EPISODES, EPISODES - 2, EPISODES, EPISODES - 2]


def test_an_evaluation_counts_episodes_that_diverged_and_reports_missing_experts(run, monkeypatch, tmp_path):
    run = dataclasses.replace(run, evaluate=dataclasses.replace(run.evaluate, episodes=3, seeds=1, p=(0.0, 1.0)))
    real = DMCProblem.batch
    monkeypatch.setattr(DMCProblem, "batch", lambda problem, variations: Breaking(real(problem, variations), False))
    problem = registry.of(run)
    agents = {evaluate.Agent("random"): problem.references(run)["random"]}

    def broken():
        results = evaluate.online(run, agents)
        return [row.get("broken") for row in summaries.result_rows(frame(*(r.block(run, "x", "evaluated") for r in results)))]

    assert broken() == [4, 4]
    monkeypatch.undo()
    file = f"{tmp_path}/run.toml"
    assert broken() == [None, None]
    assert "4 of the evaluated tasks" in problem.missing_reference(run, file)
    assert f"`icrl-dist train experts-{file} --out OTHER` trains them" in problem.missing_reference(run, file)
    do(run, jobs_of(run)[0])
    assert "2 of the evaluated tasks" in problem.missing_reference(run, file)
    assert EXPERT not in problem.references(run)
    do(run, jobs_of(run)[1])
    assert problem.references(run)[EXPERT].ceiling and problem.missing_reference(run, file) == ""


def test_a_rollout_that_diverged_fails_its_job(run, monkeypatch):
    icaa = dataclasses.replace(run, method="icaa")
    job, weights = jobs_of(icaa, phase=1)[0], FixedWeights(icaa)
    assert len(do(icaa, job, weights)) == len(list(job.identities()))
    real = DMCProblem.batch
    monkeypatch.setattr(DMCProblem, "batch", lambda problem, variations: Breaking(real(problem, variations), True))
    with pytest.raises(RuntimeError, match=r"adapt/0/0/1/0, adapt/0/1/1/0: the simulation diverged"):
        do(icaa, job, weights)


def test_the_actions_of_the_model_become_labels(run):
    icaa = dataclasses.replace(run, method="icaa")
    trials = do(icaa, jobs_of(icaa, phase=1)[0], FixedWeights(icaa))
    own = [t for t in trials if t.identity[:4] == trials[0].identity[:4]]
    examples = known(self_labelled(icaa, own))
    later = own[icaa.icaa.context_trials + 1 :]
    np.testing.assert_array_equal(examples.labels, np.concatenate([t.actions for t in later]))
    np.testing.assert_array_equal(examples.queries, np.concatenate([t.observations[:-1] for t in later]))
    assert examples.actions.dtype == np.float32 and examples.actions.shape[2] == 2
