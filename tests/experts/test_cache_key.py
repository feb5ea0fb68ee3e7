"""The key of a cached history: what it depends on, and that it stays the same otherwise."""

import dataclasses
import hashlib
import itertools
import math
from importlib import metadata
from typing import Any

import numpy as np
import pytest

from icrl_dist.config import plugins
from icrl_dist.config.sac import SACConfig
from icrl_dist.experts import cache, checkpoints
from icrl_dist.problems.continuous import network_adversary
from icrl_dist.problems.dmc import domains
from icrl_dist.types import NULL, Adversary, Task, Variation
from tests.experts.histories import HORIZON, run
from tests.jobs import do, jobs_of
from tests.optional import known
from tests.toys.site import CORRIDOR, SLIPPERY, installed

__all__ = ["run"]

SAC = SACConfig(
    hidden=(8, 8),
    actor_rate=1e-4,
    critic_rate=3e-4,
    temperature_rate=3e-4,
    tau=0.005,
    gamma=0.9,
    batch=16,
    random_steps=40,
    warmup=40,
    replay=1000,
    temperature=5e-3,
    update_every=2,
    steps=200,
    cache="anywhere",
)
CHANGED = {
    "hidden": (8, 9),
    "actor_rate": 1.1e-4,
    "critic_rate": 3.1e-4,
    "temperature_rate": 4e-4,
    "tau": 0.006,
    "gamma": 0.8,
    "batch": 32,
    "random_steps": 60,
    "warmup": 60,
    "replay": 100,
    "temperature": 6e-3,
    "update_every": 3,
    "steps": 220,
    "cache": "elsewhere",
    "checkpoints": 2,
    "checkpoint_episodes": 1,
    "least_return": -1.0,
    "least_return_disturbed": -1.0,
    "failed_experts": "teach",
}
"""Another value of every setting in ``[sac]``."""
NO_EFFECT = ("cache", "checkpoint_episodes", "least_return", "least_return_disturbed", "failed_experts")
"""Settings that do not change a history where the others are those of ``SAC``."""
REACHER = Task.of("dmc-reacher-easy", arm_mass=0.04, hand_mass=1 / 30, forces="paper", horizon=20)
PUSHED = Variation(REACHER, network_adversary.network(7, 6, 2, 0.1))
PICK_PLACE = Variation(Task.of("metaworld-pick-place", object=(0.0, 0.6, 0.02), goal=(0.0, 0.8, 0.1), horizon=20))


def key(variation=PUSHED, sac=SAC, horizon=20, seed=3, trainer="lockstep", trials=1):
    return cache.key(variation, horizon, sac, seed, trainer, trials)


@pytest.fixture
def fixed_versions(monkeypatch):
    """Every library has version 1.0, and ``fixed_versions(name)`` gives one of them version 2.0."""

    def newer(*names):
        monkeypatch.setattr(metadata, "version", lambda name: "2.0" if name in names else "1.0")

    newer()
    return newer


def test_the_key_of_a_fixed_variation_never_changes(fixed_versions, monkeypatch):
    monkeypatch.setattr(cache, "EXPERTS_VERSION", 1)
    assert key() == "822b002b73fcbe5963213c64a22eb9d88e0231ff54e3ee099d7ef411135ffd2a", (
        "the keys have changed, so every cached expert would be trained again.  If trained bytes change: raise EXPERTS_VERSION "
        "and leave the rest of the key as it is; if a setting that enters training is new: add it to SAC above and write down "
        "its key here; else find the accidental change"
    )


def test_classes_with_other_names_and_modules_have_the_same_key():
    class Settings(SACConfig):
        pass

    class Mdp(Task):
        pass

    class Opponent(Adversary):
        pass

    moved = Variation(Mdp(*dataclasses.astuple(REACHER)), Opponent(*dataclasses.astuple(PUSHED.adversary)))
    assert key(moved, Settings(**vars(SAC))) == key()


def test_the_version_of_the_code_and_all_arguments_change_the_key(monkeypatch):
    keys = [
        key(),
        key(Variation(REACHER)),
        key(Variation(REACHER.replace(arm_mass=0.05), PUSHED.adversary)),
        key(Variation(REACHER.replace(forces="qarl"), PUSHED.adversary)),
        key(Variation(REACHER, network_adversary.network(8, 6, 2, 0.1))),
        key(Variation(REACHER, network_adversary.network(7, 6, 2, math.nextafter(0.1, 1)))),
        key(Variation(Task("dmc-reacher-hard", REACHER.params), PUSHED.adversary)),
        key(horizon=40),
        key(seed=4),
        key(trainer="lockstep, cuda"),
        key(trainer="stable-baselines3"),
        key(sac=dataclasses.replace(SAC, steps=20 * 300)),
        key(sac=dataclasses.replace(SAC, steps=20 * 300), trials=201),
    ]
    monkeypatch.setattr(cache, "EXPERTS_VERSION", cache.EXPERTS_VERSION + 1)
    keys.append(key())
    assert len(set(keys)) == len(keys)


def digest(run, sac):
    """Digest of the histories that a job of a run with these settings caches."""
    changed = dataclasses.replace(run, sac=sac, stream=dataclasses.replace(run.stream, job_tasks=1))
    job = jobs_of(changed)[0]
    do(changed, job)
    found = [known(cache.load_any(variation, HORIZON, sac, run.seed)) for variation in job.variations]
    return hashlib.sha256(b"".join(array.tobytes() for one in found for array in one.arrays().values())).hexdigest()


@pytest.fixture(scope="module")
def unchanged():
    """The digest with unchanged settings, computed once."""
    return []


@pytest.mark.parametrize("name", [item.name for item in dataclasses.fields(SACConfig)])
def test_a_setting_is_in_the_key_if_and_only_if_it_changes_the_history(run, unchanged, tmp_path, monkeypatch, name):
    worse = itertools.count()  # of several checkpoints the first is the best; in a real training this short all are equal
    monkeypatch.setattr(checkpoints, "evaluate", lambda env, *_: np.full((1, env.batch), -float(next(worse))))
    sac = dataclasses.replace(SAC, cache=str(tmp_path / "a"))
    unchanged[:] = unchanged or [digest(run, sac)]
    value = str(tmp_path / "b") if name == "cache" else CHANGED[name]
    change: dict[str, Any] = {name: value}
    other = dataclasses.replace(sac, **change)
    changes = digest(run, other) != unchanged[0]
    assert (key(sac=other) != key(sac=sac)) == changes
    assert changes == (name not in NO_EFFECT), "another value would show it"


def test_the_episodes_of_an_evaluation_are_in_the_key_only_with_several_checkpoints():
    several = dataclasses.replace(SAC, checkpoints=2)
    assert len({key(), key(sac=several), key(sac=dataclasses.replace(several, checkpoint_episodes=1))}) == 3
    assert key(sac=dataclasses.replace(SAC, checkpoint_episodes=1)) == key()


@pytest.mark.integration
def test_no_setting_outside_of_the_problem_and_sac_is_in_the_key(run):
    """Neither those of the model, of workers and the stream, nor of evaluation and alerts."""

    def keys(run):
        return {key(variation, run.sac, HORIZON, run.seed) for job in jobs_of(run) for variation in job.variations}

    before, tried = keys(run), 0
    for section in dataclasses.fields(run):
        if section.name in ("sac", "control") or not dataclasses.is_dataclass(getattr(run, section.name)):
            continue
        of = getattr(run, section.name)
        for item in dataclasses.fields(of):
            value = getattr(of, item.name)
            if (section.name, item.name) == ("adversary", "count") or type(value) not in (int, float):
                continue
            other = dataclasses.replace(run, **{section.name: dataclasses.replace(of, **{item.name: value + 1})})
            assert keys(other) == before, f"{section.name}.{item.name}"
            tried += 1
    assert tried > 40
    assert keys(dataclasses.replace(run, method="dpt")) < before
    for name, value in {"forces": "qarl", "strength": 2.0, "horizon": 40}.items():
        control = dataclasses.replace(run.section("control"), **{name: value})
        shared = keys(dataclasses.replace(run, control=control)) & before
        undisturbed = {key(v, run.sac, HORIZON, run.seed) for j in jobs_of(run) for v in j.variations if v.adversary == NULL}
        assert shared == (undisturbed if name == "strength" else set()), name


@pytest.mark.parametrize(
    ("variation", "trainer", "used"),
    [
        (PUSHED, "lockstep", {"numpy", "torch", "mujoco", "dm-control"}),
        (PUSHED, "lockstep, cuda", {"numpy", "torch", "mujoco", "dm-control"}),
        (PUSHED, "stable-baselines3", {"numpy", "torch", "mujoco", "dm-control", "stable-baselines3"}),
        (PICK_PLACE, "lockstep", {"numpy", "torch", "mujoco", "metaworld"}),
    ],
)
def test_a_newer_library_changes_the_keys_of_the_experts_that_use_it(fixed_versions, variation, trainer, used):
    before = key(variation, trainer=trainer)
    for name in sorted({*used, "numpy", "torch", "dm-control", "metaworld", "mujoco", "stable-baselines3", "gymnasium", "ray"}):
        fixed_versions(name)
        assert (key(variation, trainer=trainer) != before) == (name in used), name


def test_an_expert_of_another_package_has_the_version_of_its_distribution(tmp_path):
    def keyed(site, text, number):
        with installed(tmp_path / site, {"toy_problem.py": text}, number=number):
            return key(Variation(Task.of("toy", cells=6, horizon=20, goal=1)))

    one = keyed("one", CORRIDOR, "1.0")
    assert keyed("moved", CORRIDOR, "1.0") == one
    assert keyed("edited", SLIPPERY, "1.0") == one, "the author gives changed code a new version"
    assert keyed("newer", CORRIDOR, "1.1") != one


def test_the_problems_of_this_package_name_their_simulators():
    assert plugins.find("problems", "darkroom").libraries == ()
    for name in domains.PROBLEMS:
        assert plugins.find("problems", name).libraries == ("dm-control", "mujoco")
