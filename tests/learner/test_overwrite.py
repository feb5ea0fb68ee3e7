"""Commands replace only what they may replace: complete runs in one process, and every refused command."""

import json
import shutil

import pytest
import torch

from actors import fleet
from icrl_dist.cli import main as cli
from icrl_dist.config.run import ConfigError, dumps, load, override
from icrl_dist.launch import run_folder
from icrl_dist.launch import train as launch
from icrl_dist.results import heldout
from icrl_dist.storage.checkpoint import Checkpoint, load_checkpoint, save_checkpoint, version_file
from icrl_dist.storage.files import held, hold
from icrl_dist.stream import wire
from tests.launch.test_run_folder import files
from tests.learner.test_service import no_tensorboard

pytestmark = pytest.mark.integration

__all__ = ["no_tensorboard"]


def train(*words):
    return cli.main(["train", *map(str, words)])


@pytest.fixture(scope="module")
def finished(module_run, no_tensorboard, tmp_path_factory):
    """The folder of a finished and evaluated run that no test changes."""
    place = tmp_path_factory.mktemp("finished")
    (place / "small.toml").write_text(dumps(module_run))
    assert train(place / "small.toml", "--engine", "inline", "--out", place / "run") == 0
    return place / "run"


@pytest.fixture
def run(finished, tmp_path, monkeypatch):
    """A copy of the finished run, beside its run file."""
    monkeypatch.setattr(run_folder, "WAIT_S", 0.05)
    shutil.copyfile(finished.parent / "small.toml", tmp_path / "small.toml")
    folder = shutil.copytree(finished, tmp_path / "run")
    result = (folder / "result.json").read_text()
    (folder / "result.json").write_text(result.replace(str(finished), str(folder)))
    return folder


def words(run, *more):
    return (run.parent / "small.toml", "--engine", "inline", "--out", run, *more)


def refused(capsys, code, *given):
    assert train(*given) == code
    (line,) = capsys.readouterr().err.strip().splitlines()
    return line


def test_a_finished_run_contains_only_our_files(finished):
    assert run_folder.foreign(finished) == []


def test_contradictory_flags_change_nothing(run, capsys):
    before = files(run.parent)
    assert "--resume --overwrite" in refused(capsys, 2, *words(run, "--resume", "--overwrite"))
    assert files(run.parent) == before


def test_an_empty_out_is_the_current_folder_and_refused(run, capsys, monkeypatch):
    monkeypatch.chdir(run)
    before = files(run.parent)
    for out in ("", ".", ".."):
        line = refused(capsys, 2, run.parent / "small.toml", "--engine", "inline", "--overwrite", "--out", out)
        assert "the current folder" in line or "ends in .." in line
    assert files(run.parent) == before


def test_without_a_gpu_the_earlier_run_is_restored(run, capsys, monkeypatch):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    before = files(run.parent)
    assert "torch finds no GPU" in refused(capsys, 1, *words(run, "--overwrite", "--learner.device", "cuda"))
    assert files(run.parent) == before


def test_without_a_cluster_the_earlier_run_is_restored(run, capsys, monkeypatch):
    def absent(*_):
        raise ConfigError("--address auto: no answer")

    monkeypatch.setattr(fleet, "Fleet", absent)
    before = files(run.parent)
    line = refused(capsys, 2, run.parent / "small.toml", "--address", "auto", "--out", run, "--overwrite")
    assert "no answer" in line and files(run.parent) == before


def test_a_refused_fork_changes_nothing(run, finished, capsys):
    before = files(run.parent)
    given = ("--from", f"{finished}@0", "--engine", "inline", "--out", run, "--overwrite", "--set", "model.width=32")
    line = refused(capsys, 2, *given)
    assert "model.width = 32 (parent: 16): a fork has its parent's problem, split, method and model" in line
    assert files(run.parent) == before


def test_a_fork_never_replaces_its_parent(run, capsys):
    before = files(run.parent)
    given = ("--from", f"{run}@0", "--engine", "inline", "--out", run, "--overwrite")
    assert "the run of --from" in refused(capsys, 2, *given)
    assert files(run.parent) == before


def test_a_running_run_is_not_replaced(run, capsys):
    before = files(run.parent)
    with hold(run):
        assert "a run is active in this folder" in refused(capsys, 2, *words(run, "--overwrite"))
    assert files(run.parent) == before


def test_the_users_files_beside_a_run_are_named_and_kept(run, capsys):
    (run / "notes.md").write_text("mine")
    before = files(run.parent)
    assert "holds notes.md, not written by icrl-dist" in refused(capsys, 2, *words(run, "--overwrite"))
    assert files(run.parent) == before


def test_an_interrupted_new_run_leaves_the_earlier_one(run, capsys, monkeypatch):
    def interrupted(run_settings, folder, report):
        (folder / "learner.log").touch()
        raise launch.TrainInterrupted

    monkeypatch.setattr(launch, "train_inline", interrupted)
    before = files(run.parent)
    assert train(*words(run, "--overwrite")) == 130
    printed = capsys.readouterr().out
    assert f"interrupted; {run} is as it was before" in printed and "--resume" not in printed
    assert files(run.parent) == before


def test_a_new_run_replaces_the_earlier_at_its_first_checkpoint_and_is_locked_during_evaluation(run, monkeypatch):
    seen, online, aside = [], heldout.online, run_folder.aside_of(run)

    def evaluated(*given):
        seen.append((held(run), aside.exists()))
        return online(*given)

    real = launch.train_inline

    def trained(run_settings, folder, report):
        def observe(event):
            report(event)
            if event["event"] == "progress":
                seen.append((event["version"] >= 0, aside.exists()))

        return real(run_settings, folder, observe)

    monkeypatch.setattr(heldout, "online", evaluated)
    monkeypatch.setattr(launch, "train_inline", trained)
    assert train(*words(run, "--overwrite", "--seed", "1")) == 0
    assert {there for begun, there in seen[:-1] if not begun} == {True}
    assert {there for begun, there in seen[:-1] if begun} == {False}
    assert seen[-1] == (True, False) and load(str(run / "run.toml")).seed == 1


def test_resuming_a_finished_run_changes_no_result(run):
    stamps = {path: path.stat().st_mtime_ns for path in (run / "checkpoints").iterdir()}
    result = json.loads((run / "result.json").read_text())
    result["seconds"] = 12345.6
    (run / "result.json").write_text(json.dumps(result, indent=1) + "\n")
    before = (run / "result.json").read_bytes()
    assert train(*words(run, "--resume")) == 0
    assert (run / "result.json").read_bytes() == before
    assert {path: path.stat().st_mtime_ns for path in (run / "checkpoints").iterdir()} == stamps


def test_a_repaired_finished_run_keeps_its_seconds_and_counts_the_repair(run):
    result = json.loads((run / "result.json").read_text())
    (run / "result.json").write_text(json.dumps(result | {"seconds": 12345.6}))
    path = sorted((run / "dataset").glob("segment-*"))[0]
    content = bytearray(path.read_bytes())
    content[len(content) // 2] ^= 1
    path.write_bytes(content)
    assert train(*words(run, "--resume")) == 0
    after = json.loads((run / "result.json").read_text())
    assert (after["seconds"], after["repaired"], after["dataset_digest"]) == (12345.6, 1, result["dataset_digest"])


def test_a_report_of_other_settings_is_not_replaced(run):
    def evaluate(what, *more):
        assert cli.main(["evaluate", str(what), "--episodes", "2", "--seeds", "1", *more]) == 0
        return files(run / "report")

    before = files(run / "report")
    assert sorted(name.rpartition(".")[2] for name in before) == ["json", "png"]
    known = before
    others = [
        (run, "--p", "0"),
        (run, "--p", "0.3"),
        (run, "--prior", "uniform"),
        (run, "--episodes", "3"),
        (run, "--seeds", "2"),
    ]
    for what, *more in [(run,), *others]:
        after = evaluate(what, *more)
        assert len(after) == len(known) + 2, more
        assert {name: after[name] for name in known} == known
        known = after
    assert evaluate(run) == known, "the same settings replace their own report"
    shutil.copyfile(version_file(run, 2), run / "agent.npz")
    after = evaluate(run / "agent.npz")
    assert len(after) == len(known) + 2, "a file's report, without T^0, beside its folder's"
    made = load_checkpoint(version_file(run, 2))
    arrays = {name: array + 1e-3 if array.dtype.kind == "f" else array for name, array in made.arrays.items()}
    digest = wire.weights_digest(Checkpoint(arrays, {}).part("model"))
    save_checkpoint(run / "agent.npz", Checkpoint(arrays, {**made.manifest, "weights_digest": digest}))
    assert len(evaluate(run / "agent.npz")) == len(after) + 2, "another agent in a file of the same name"
    run_override = override(load(str(run / "run.toml")), [f"evaluate.p={[n / 100 for n in range(50)]}"], "--set")
    assert len(heldout.report_name(run_override, run)) < 200
    assert run_folder.foreign(run) == []


def test_an_export_replaces_only_an_export(run, capsys):
    (run.parent / "notes.txt").write_text("mine")
    before = files(run.parent)
    for out in (run.parent / "notes.txt", version_file(run, 2)):
        assert cli.main(["export", str(run), "--out", str(out)]) == 2
        assert f"--out {out}: exists and is not an exported agent" in capsys.readouterr().err
    assert files(run.parent) == before
    for _ in range(2):
        assert cli.main(["export", str(run)]) == 0
    assert load_checkpoint(run / "agent.npz").part("model")
