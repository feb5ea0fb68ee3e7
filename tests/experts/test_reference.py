"""An expert that trains alone is trained by stable-baselines3, on the engine's parameters, batches and noise."""

import dataclasses

import numpy as np
import pytest
import stable_baselines3
import torch

from icrl_dist.collect import jobs
from icrl_dist.experts import train as experts
from icrl_dist.experts.sac.batched import SACBatch, train
from icrl_dist.experts.sac.one import Expert
from icrl_dist.experts.sac.sb3_files import load
from tests.experts.test_batched import LINE, SMALL, SPEC, Line, by_sb3, drawn
from tests.experts.test_train import KilledError, asked, digests, run  # noqa: F401

BY = "stable-baselines3"


def test_its_updates_are_stable_baselines3s_own_and_the_engines_up_to_rounding(tmp_path, monkeypatch):
    alone, engine = SACBatch([0], SPEC, SMALL, "cpu", by=BY), SACBatch([0], SPEC, SMALL, "cpu")
    alone.save_sb3(0, tmp_path / "before.zip")
    for batch, noise in drawn(SMALL, 10, experts=1):
        alone.update(batch, noise)
        engine.update(batch, noise)
    by_sb3(Expert.load(tmp_path / "before.zip", device="cpu"), 0, drawn(SMALL, 10, experts=1), monkeypatch).save(
        tmp_path / "after.zip"
    )
    theirs, updates = load(tmp_path / "after.zip", SPEC, SMALL, (alone.actor_shape, alone.critic_shape))
    assert updates == alone.updates == 10
    for name, array in alone.arrays.items():
        torch.testing.assert_close(array[0], theirs[name], atol=1e-6, rtol=1e-4, msg=name)
        torch.testing.assert_close(array, engine.arrays[name], atol=2e-5, rtol=1e-3, msg=name)
    moved = SACBatch([0], SPEC, SMALL, "cpu")
    assert all(not torch.equal(alone.arrays[name], array) for name, array in moved.arrays.items())


def test_its_training_goes_on_from_a_state_and_leaves_the_global_generators_alone():
    kept = {}
    torch.manual_seed(3)
    before = torch.get_rng_state(), np.random.get_state()[1].tolist()
    whole = train(Line(1), LINE, 35, [5], lambda e, _: kept.update({e.steps: e.state()}), "cpu", by=BY).state()
    assert torch.equal(before[0], torch.get_rng_state()) and before[1] == np.random.get_state()[1].tolist()
    again = train(Line(1), LINE, 35, [5], device="cpu", state=kept[21], by=BY).state()
    assert whole["updates"] == 8 and not np.array_equal(kept[21]["actor"], whole["actor"])
    for name, array in whole.items():
        np.testing.assert_array_equal(again[name], array, err_msg=name)


@pytest.mark.parametrize("more", [{"seeds": [0, 1]}, {"products": "bfloat16"}])
def test_what_stable_baselines3_has_not_is_refused(more):
    with pytest.raises(ValueError, match=r"stable-baselines3: . experts.*take lockstep"):
        SACBatch(**{"seeds": [0], "spec": SPEC, "config": SMALL, "device": "cpu", "by": BY, **more})


def test_a_job_of_one_expert_is_its_and_resumes_to_the_same_bytes_and_one_of_two_is_not(run, monkeypatch):  # noqa: F811
    trained, real = [], stable_baselines3.SAC.train
    monkeypatch.setattr(stable_baselines3.SAC, "train", lambda self, *given: trained.append(type(self)) or real(self, *given))
    whole = asked(run)[0]
    none = dataclasses.replace(run, sac=dataclasses.replace(run.sac, cache=""))
    pair = dataclasses.replace(asked(none)[0], variations=whole.variations[:2], tasks=1)
    list(jobs.do(pair, None, "w"))
    assert not trained
    undisturbed = digests(jobs.do(dataclasses.replace(pair, variations=whole.variations[:1]), None, "w"))
    updates = len(trained)
    assert updates == (run.sac.steps - run.sac.warmup) // run.sac.update_every and set(trained) == {Expert}
    one, begun = dataclasses.replace(whole, variations=whole.variations[:1], tasks=1), []
    save = experts.save_checkpoint

    def killed(path, checkpoint):
        save(path, checkpoint)
        begun.append(path)
        if len(begun) == 5:
            raise KilledError

    monkeypatch.setattr(experts, "CHECKPOINT_S", 0.0)
    monkeypatch.setattr(experts, "save_checkpoint", killed)
    with pytest.raises(KilledError):
        list(jobs.do(one, None, "w"))
    assert digests(jobs.do(one, None, "w")) == undisturbed
    assert len(trained) == 2 * updates, "no episode was trained twice"
