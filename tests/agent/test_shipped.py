"""Agents as single files: exported from a run, and shipped with the package."""

import dataclasses
import json
from pathlib import Path

import numpy as np
import pytest
import torch

from icrl_dist.agent.loading import SHIPPED, load_agent, shipped, trained
from icrl_dist.cli import main
from icrl_dist.config.run import ConfigError, parse
from icrl_dist.interfaces import MakePolicy, Reference
from icrl_dist.models.dpt import PretrainedTransformer
from icrl_dist.models.weights import weights_of
from icrl_dist.problems import registry
from icrl_dist.results import evaluate
from icrl_dist.storage.checkpoint import Checkpoint, load_checkpoint, save_checkpoint, version_file
from icrl_dist.training.fit import Optimizer
from learner import checkpoints


@pytest.fixture
def folder(small_run, tmp_path):
    """A run folder with versions 0 and 1, optimizer and list of data included."""
    spec = registry.of(small_run).spec
    for version in (0, 1):
        torch.manual_seed(version)
        model = PretrainedTransformer(spec, small_run.model)
        opt = Optimizer(model, small_run.optim)
        torch.stack([p.sum() for p in model.parameters()]).sum().backward()
        opt.step(1e-3)
        about = checkpoints.manifest(small_run, spec, version, 1)
        weights = checkpoints.weights(version, model)
        checkpoints.save(version_file(tmp_path, version), weights, opt, {**about, "dataset": ["a"], "dataset_digest": "d"})
    return tmp_path


def test_an_exported_agent_is_the_newest_version_without_what_only_training_needs(folder, tmp_path, capsys):
    assert main.main(["export", str(folder), "--to", "agent"]) == 0
    assert str(folder / "agent.npz") in capsys.readouterr().out
    source, made = load_checkpoint(version_file(folder, 1)), load_checkpoint(folder / "agent.npz")
    kept = {name for name in source.arrays if name.startswith("model/")}
    assert set(made.arrays) == kept | {f"outcomes/{name}" for name in ("readout", "deviation", "typical", "rare")}
    assert made.manifest == {name: value for name, value in source.manifest.items() if name != "dataset"}
    whole, exported = load_agent(folder, seed=0), load_agent(folder / "agent.npz", seed=0)
    for name, value in weights_of(whole.model).items():
        np.testing.assert_array_equal(weights_of(exported.model)[name], value)
    other = tmp_path / "elsewhere" / "old.npz"
    assert main.main(["export", str(version_file(folder, 0)), "--out", str(other)]) == 0
    assert load_agent(other).manifest["version"] == 0


def test_export_to_a_folder_is_refused(folder, capsys):
    assert main.main(["export", str(folder), "--out", str(folder)]) == 2
    assert "is a folder; name a file" in capsys.readouterr().err


def test_shipped_agents_are_small_and_their_manifests_name_run_seed_and_digests():
    assert "darkroom" in SHIPPED
    for name in SHIPPED:
        assert shipped(name).stat().st_size < 1_000_000
        manifest = load_checkpoint(shipped(name)).manifest
        assert {"run", "seed", "versions", "weights_digest", "dataset_digest", "test_goals"} <= set(manifest)


@pytest.mark.integration
def test_a_shipped_agent_is_loaded_by_its_name_and_finds_goals_it_never_trained_on(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    words = ["evaluate", "--pretrained", "darkroom", "--episodes", "5", "--seeds", "1", "--p", "0", "--json"]
    assert main.main(words) == 0
    answer = json.loads(capsys.readouterr().out.splitlines()[-1])
    rows = {row["agent"]: row["episodes"] for row in answer["rows"]}
    kept, frozen = (agent for agent in rows if agent.startswith("T^"))
    assert (answer["deploy"], frozen) == ("committed", f"{kept}, Algorithm 1")
    assert rows[kept][-1] > 0.8 * rows["oracle"][-1] and rows[frozen][0] < 5 < rows[kept][0]
    over, soon = (answer[name]["0"] for name in ("first10_over_oracle", "episode_of_90"))
    assert over == pytest.approx(sum(rows[kept]) / sum(rows["oracle"]), abs=1e-3) and over > 0.6
    assert soon is None or rows[kept][soon - 1] >= 0.9 * np.mean(rows["oracle"])
    report = Path(answer["figure"])
    assert report.is_file() and report.resolve().parent == tmp_path / "runs" / "darkroom-pretrained" / "report"
    assert report.name.endswith("-committed-unseen-p0-5episodes-1seeds.png")
    assert load_agent("darkroom").manifest["size"] == 10


@pytest.mark.integration
def test_a_shipped_agent_with_shuffled_weights_is_no_better_than_a_random_policy():
    """All that the agent learned of the environment is in its weights."""
    checkpoint = load_checkpoint(shipped("darkroom"))
    run = parse(checkpoint.manifest["run"], "shipped")
    run = dataclasses.replace(run, evaluate=dataclasses.replace(run.evaluate, episodes=3, seeds=1, p=(0.0,)))
    untouched, shuffled = trained(checkpoint), trained(checkpoint)
    torch.manual_seed(0)
    with torch.no_grad():
        for parameter in shuffled.model.parameters():
            parameter.copy_(parameter.flatten()[torch.randperm(parameter.numel())].view_as(parameter))
    models = {"trained": untouched, "shuffled": shuffled}
    agents: dict[evaluate.Agent, MakePolicy | Reference] = {
        evaluate.Agent(key): evaluate.in_context(model, run.context) for key, model in models.items()
    }
    agents[evaluate.Agent("random")] = registry.of(run).references(run)["random"]
    whole, mixed, random = (result.returns.mean() for result in evaluate.online(run, agents))
    assert whole > 40 and mixed < 5 and random < 5


def test_evaluate_needs_exactly_one_agent(capsys, tmp_path):
    for words in (["evaluate"], ["evaluate", str(tmp_path), "--pretrained", "darkroom"]):
        assert main.main(words) == 2
        assert "name a run folder or a checkpoint file, or with --pretrained" in capsys.readouterr().err
    assert main.main(["evaluate", "--pretrained", "darkrom"]) == 2
    assert "there are darkroom" in capsys.readouterr().err
    with pytest.raises(ConfigError, match="no agent of that name"):
        shipped("nothing")


def test_a_deployment_that_an_agent_was_not_trained_for_is_refused_in_one_line(folder, capsys):
    assert main.main(["evaluate", str(folder), "--deploy", "committed"]) == 2
    (line,) = capsys.readouterr().err.strip().splitlines()
    assert "model.window = 1" in line and "'paper'" in line
    assert load_checkpoint(version_file(folder, 1)).manifest["window"] == 1


def test_a_file_of_that_name_does_not_hide_the_shipped_agent(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    save_checkpoint(tmp_path / "darkroom", Checkpoint({}, {}))
    assert load_agent("darkroom").manifest["method"] == "icag"


def test_an_agent_uses_its_own_number_of_threads_and_leaves_that_of_the_process(monkeypatch):
    during = []

    def seen(call):
        def observed(*arguments):
            during.append(torch.get_num_threads())
            return call(*arguments)

        return observed

    def play(agent):
        for name in ("act", "observe", "distribution"):
            monkeypatch.setattr(agent._policy, name, seen(getattr(agent._policy, name)))
        during.clear()
        (action,) = agent.act(np.zeros((1, 2)))
        agent.observe(np.zeros((1, 2)), [action], [0.0], np.ones((1, 2)), [False])
        agent.distribution(np.zeros((1, 2)))
        return during

    torch.set_num_threads(2)
    try:
        assert play(load_agent("darkroom", seed=0)) == [1, 1, 1]
        assert play(load_agent("darkroom", seed=0, threads=3)) == [3, 3, 3]
        assert play(load_agent("darkroom", seed=0, threads=None)) == [2, 2, 2]
        agent = load_agent("darkroom")
        with pytest.raises(ValueError, match="obs has shape"):
            agent.act(np.zeros((2, 2)))
        assert torch.get_num_threads() == 2
    finally:
        torch.set_num_threads(1)
    with pytest.raises(ConfigError, match="threads = 0: expected a whole number of at least 1, or None"):
        load_agent("darkroom", threads=0)
