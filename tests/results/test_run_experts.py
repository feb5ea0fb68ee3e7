"""The experts of a run as files of stable-baselines3, with a manifest; what was not kept is refused."""

import dataclasses
import json

import numpy as np
import pytest
import stable_baselines3

from icrl_dist.cli import main
from icrl_dist.config.run import ConfigError, dumps
from icrl_dist.experts import cache
from icrl_dist.experts.cache import expert_seed
from icrl_dist.experts.sac import draws
from icrl_dist.experts.train import ExpertPolicy
from icrl_dist.problems import registry
from icrl_dist.results import run_experts
from icrl_dist.storage.checkpoint import Checkpoint, load_checkpoint, save_checkpoint
from icrl_dist.types import Task
from tests.experts.histories import HORIZON, run
from tests.jobs import do, in_problem, jobs_of
from tests.optional import known
from tests.problems.dmc.test_simulation import flat, reference

pytestmark = pytest.mark.integration

__all__ = ["run"]


@pytest.fixture
def balancing(run):
    """A run that balances the pole, whose experts earn something after ten episodes."""
    section = dataclasses.replace(run.section("control"), train_tasks=4)
    return in_problem(run, "dmc-cartpole-balance", control=section)


def folder_of(run, path):
    path.mkdir()
    (path / "run.toml").write_text(dumps(run))
    return path


def trained_folder(run, path):
    for job in jobs_of(run):
        do(run, job)
    return folder_of(run, path)


def refusal(capsys, *words):
    assert main.main(["export", *map(str, words)]) == 2
    (line,) = capsys.readouterr().err.strip().splitlines()
    return line


def test_the_files_act_as_the_experts_and_earn_in_dm_control_what_the_manifest_says(balancing, tmp_path, capsys):
    folder, out = trained_folder(balancing, tmp_path / "run"), tmp_path / "sb3"
    assert main.main(["export", str(folder), "--to", "sb3", "--out", str(out)]) == 0
    manifest = json.loads((out / "manifest.json").read_text())
    entries = manifest["experts"]
    assert f"{out}: {len(entries)} experts for stable_baselines3.SAC.load" in capsys.readouterr().out
    variations = [(job.seed, v) for job in jobs_of(balancing) for v in job.variations]
    assert len(entries) == len(variations) == 8 == len(list(out.glob("*.zip"))) and manifest["episodes"] == 10
    rng = np.random.default_rng(0)
    for entry, (seed, variation) in zip(entries, variations, strict=True):
        task = variation.task
        assert entry["task"] == {"kind": task.kind, **dict(task.params)}
        assert entry["adversary"]["kind"] == variation.adversary.kind and entry["horizon"] == HORIZON
        model = stable_baselines3.SAC.load(out / entry["file"], device="cpu")
        observations = rng.normal(size=(50, entry["observations"])).astype(np.float32)
        history = known(cache.load_any(variation, HORIZON, balancing.sac, balancing.seed))
        ours = ExpertPolicy([history] * 50, balancing.sac).act(observations, np.zeros((50, 1)))
        np.testing.assert_allclose(model.predict(observations, deterministic=True)[0], ours, atol=1e-5)
        if variation.adversary.params:
            continue
        expert, spec = expert_seed(variation, seed), registry.spec(task)
        physical = Task(task.kind, tuple((name, value) for name, value in task.params if name.endswith("mass")))
        plain = []
        for episode in range(manifest["episodes"]):
            start = np.random.default_rng(draws.key(expert, draws.EVALUATION, episode)).integers(2**32)
            env, total = reference(task.kind, physical, int(start)), 0.0
            step = env.reset()
            for _ in range(HORIZON):
                low, high = np.array(spec.low, np.float32), np.array(spec.high, np.float32)
                shown = np.clip(np.asarray(flat(step.observation), np.float32), low, high)
                step = env.step(model.predict(shown, deterministic=True)[0])
                total += step.reward
            plain.append(total)
        np.testing.assert_allclose(plain, entry["returns"], atol=0.01)
        assert abs(np.mean(plain) - entry["return"]) < 0.01 < entry["return"]


def test_a_second_export_replaces_the_first_and_no_other_file(run, tmp_path, capsys):
    folder, out = trained_folder(run, tmp_path / "run"), tmp_path / "sb3"
    first = run_experts.export(folder, out)
    assert run_experts.export(folder, out) == first
    (out / "mine.txt").write_text("precious")
    assert "holds other files, such as mine.txt; name a new folder" in refusal(capsys, folder, "--to", "sb3", "--out", out)
    assert (out / "mine.txt").read_text() == "precious" and (out / "manifest.json").exists()
    assert "is a file; name a folder" in refusal(capsys, folder, "--to", "sb3", "--out", out / "mine.txt")
    assert "name a folder for the experts" in refusal(capsys, folder, "--to", "sb3")


def test_experts_that_were_not_kept_are_refused_with_the_command_that_trains_them(run, small_run, tmp_path, capsys):
    out = tmp_path / "sb3"
    do(run, jobs_of(run)[0])
    folder = folder_of(run, tmp_path / "run")
    line = refusal(capsys, folder, "--to", "sb3", "--out", out)
    assert f"4 of its 8 experts are not in {run.sac.cache}" in line
    assert f"`icrl-dist train experts-{folder}/run.toml --out OTHER` trains the missing ones" in line
    none = dataclasses.replace(run, sac=dataclasses.replace(run.sac, cache=""))
    line = refusal(capsys, folder_of(none, tmp_path / "none"), "--to", "sb3", "--out", out)
    assert "were not kept (sac.cache = '')" in line and "--sac.cache" in line
    line = refusal(capsys, folder_of(small_run, tmp_path / "room"), "--to", "sb3", "--out", out)
    assert "darkroom trains no SAC experts" in line
    assert not out.exists()


def test_a_kept_expert_of_another_shape_is_refused(run, tmp_path):
    folder = trained_folder(run, tmp_path / "run")
    job = jobs_of(run)[1]
    file = cache.file(run.sac, cache.key(job.variations[0], HORIZON, run.sac, run.seed, "lockstep"))
    stored = load_checkpoint(file)
    save_checkpoint(file, Checkpoint({**stored.arrays, "actor": stored.arrays["actor"][:-16]}, stored.manifest))
    with pytest.raises(
        ConfigError, match=r"task2-variation0 in .*: an actor of \d+ parameters .* not \d+, 6 and 2 \(sac.hidden = \[8, 8\]\)"
    ):
        run_experts.export(folder, tmp_path / "sb3")
    assert not (tmp_path / "sb3").exists()
