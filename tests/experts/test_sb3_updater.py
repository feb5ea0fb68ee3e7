"""A single expert is trained by stable-baselines3, with the engine's parameters, batches and noise."""

import dataclasses
from typing import Final

import numpy as np
import pytest
import stable_baselines3
import torch

from icrl_dist.experts import train as experts
from icrl_dist.experts.sac.batched import SACBatch, train
from icrl_dist.experts.sac.sb3_expert import Expert
from icrl_dist.experts.sac.sb3_files import load
from icrl_dist.storage.checkpoint import save_checkpoint
from tests.calls import noting
from tests.experts.histories import KilledError, digests, run  # noqa: F401
from tests.experts.sac_cases import LINE, SMALL, SPEC, Line, random_updates, updated_by_sb3
from tests.jobs import do, jobs_of

BACKEND: Final = "stable-baselines3"


def test_updates_are_those_of_stable_baselines3_and_those_of_the_engine_up_to_rounding(tmp_path, monkeypatch):
    single, engine = SACBatch([0], SPEC, SMALL, "cpu", backend=BACKEND), SACBatch([0], SPEC, SMALL, "cpu")
    single.save_sb3(0, tmp_path / "before.zip")
    for batch, noise in random_updates(SMALL, 10, experts=1):
        single.update(batch, noise)
        engine.update(batch, noise)
    updated_by_sb3(
        Expert.load(tmp_path / "before.zip", device="cpu"), 0, random_updates(SMALL, 10, experts=1), monkeypatch
    ).save(tmp_path / "after.zip")
    theirs, updates = load(tmp_path / "after.zip", SPEC, SMALL, (single.actor_shape, single.critic_shape))
    assert updates == single.updates == 10
    for name, array in single.arrays.items():
        torch.testing.assert_close(array[0], theirs[name], atol=1e-6, rtol=1e-4, msg=name)
        torch.testing.assert_close(array, engine.arrays[name], atol=2e-5, rtol=1e-3, msg=name)
    untrained = SACBatch([0], SPEC, SMALL, "cpu")
    assert all(not torch.equal(single.arrays[name], array) for name, array in untrained.arrays.items())


def test_training_continues_from_a_state_and_does_not_change_the_global_generators():
    states = {}
    torch.manual_seed(3)
    before = torch.get_rng_state(), np.random.get_state(legacy=False)["state"]["key"].tolist()
    whole = train(Line(1), LINE, 35, [5], lambda e, _: states.update({e.steps: e.state()}), "cpu", backend=BACKEND).state()
    assert (
        torch.equal(before[0], torch.get_rng_state())
        and before[1] == np.random.get_state(legacy=False)["state"]["key"].tolist()
    )
    again = train(Line(1), LINE, 35, [5], device="cpu", state=states[21], backend=BACKEND).state()
    assert whole["updates"] == 8 and not np.array_equal(states[21]["actor"], whole["actor"])
    for name, array in whole.items():
        np.testing.assert_array_equal(again[name], array, err_msg=name)


@pytest.mark.parametrize("more", [{"seeds": [0, 1]}, {"matmul_dtype": "bfloat16"}])
def test_settings_that_stable_baselines3_does_not_support_are_refused(more):
    with pytest.raises(ValueError, match=r"stable-baselines3: . experts.*use lockstep"):
        SACBatch(**{"seeds": [0], "spec": SPEC, "config": SMALL, "device": "cpu", "backend": BACKEND, **more})


def test_a_job_of_one_expert_uses_stable_baselines3_and_resumes_to_the_same_bytes(run, monkeypatch):  # noqa: F811
    trained, sac = list[type](), stable_baselines3.SAC
    monkeypatch.setattr(sac, "train", noting(trained, lambda self, *given: type(self), sac.train))
    whole = jobs_of(run)[0]
    none = dataclasses.replace(run, sac=dataclasses.replace(run.sac, cache=""))
    pair = dataclasses.replace(jobs_of(none)[0], variations=whole.variations[:2], tasks=1)
    do(run, pair)
    assert not trained
    undisturbed = digests(do(run, dataclasses.replace(pair, variations=whole.variations[:1])))
    updates = len(trained)
    assert updates == (run.sac.steps - run.sac.warmup) // run.sac.update_every and set(trained) == {Expert}
    one, begun = dataclasses.replace(whole, variations=whole.variations[:1], tasks=1), []
    save = save_checkpoint

    def killed(path, checkpoint):
        save(path, checkpoint)
        begun.append(path)
        if len(begun) == 5:
            raise KilledError

    monkeypatch.setattr(experts, "CHECKPOINT_S", 0.0)
    monkeypatch.setattr(experts, "save_checkpoint", killed)
    with pytest.raises(KilledError):
        do(run, one)
    assert digests(do(run, one)) == undisturbed
    assert len(trained) == 2 * updates, "an episode was trained twice"
