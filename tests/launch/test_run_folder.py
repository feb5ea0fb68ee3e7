"""Run folders: user files are never removed, and a replaced run is restored unless the new run has a checkpoint."""

import contextlib
import fcntl
import json
import os
import shutil
import tempfile
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from icrl_dist.chaos import campaign
from icrl_dist.chaos.training import Training
from icrl_dist.config.run import ConfigError
from icrl_dist.launch import run_folder
from icrl_dist.launch import train as launch
from icrl_dist.storage.files import hold
from tests.optional import known

OURS = (
    *("run.toml", "env.json", "fork.json", "result.json", "metrics.jsonl", "agent.npz", "learner.log", "learner.err"),
    *(
        "endpoint",
        ".lock",
        ".replacement",
        ".run.toml.123.part",
        "dataset/segment-000000.frames",
        "dataset/.segment-000001.frames.9.part",
    ),
    *("checkpoints/version-0000.npz", "checkpoints/partial.npz", "checkpoints/.version-0001.npz.7.part"),
    *("metrics.jsonl.1", "metrics.jsonl.4", "learner.log.2", "learner.err.1"),
    *("crashes/w0-1.json", "crashes/w0.stacks", "tensorboard/events.out.tfevents.1.host.2.0"),
    *("report/online-T2-0a1b2c3d-paper-unseen-p0_0.2-3episodes-2seeds.json", "report/adaptation.png", "report/online.json"),
)
"""One file of every kind that this program writes into a run folder."""
FOREIGN = (
    *("notes.md", ".git/config", "src/main.py", "run.toml.bak", "run.toml~", "report/notes.md", "report/mine.png"),
    *("dataset/segment-1.frames.bak", "checkpoints/best.npz", "crashes/why.txt", "tensorboard/x", "dataset/raw/a.csv"),
    *(".notes.md.12.part", "online.json", "version-0000.npz", "deep/run.toml", "run.toml\nx"),
)


def write(folder, names):
    for name in names:
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_text(name)
    return folder


def files(folder):
    """Every file and link below a folder, with its content or target."""
    below = sorted(folder.rglob("*"))
    return {str(p.relative_to(folder)): p.readlink() if p.is_symlink() else p.read_bytes() for p in below if not p.is_dir()}


def replaced(folder):
    """The files of the run that is kept beside a folder while another run replaces it, without the token."""
    return {name: content for name, content in files(run_folder.aside_of(folder)).items() if name != ".replacement"}


@pytest.fixture(autouse=True)
def no_wait(monkeypatch):
    monkeypatch.setattr(run_folder, "WAIT_S", 0.05)


@settings(max_examples=40, deadline=None)
@given(
    ours=st.sets(st.sampled_from(OURS)),
    users=st.sets(st.sampled_from(FOREIGN) | st.from_regex(r"[a-z]{1,6}(/[a-z.]{0,5}[a-z])?", fullmatch=True), min_size=1),
)
def test_a_folder_with_a_user_file_is_refused_by_name_and_keeps_every_file(module_run, ours, users):
    users = {name for name in users if not any((name + "/").startswith(o + "/") or o.startswith(name + "/") for o in OURS)}
    users = {name for name in users if not any(other.startswith(name + "/") for other in users)} or {"notes.md"}
    with tempfile.TemporaryDirectory() as temporary:
        folder = write(Path(temporary) / "run", {"run.toml", "env.json", *ours, *users})
        before = files(Path(temporary))
        with pytest.raises(ConfigError) as refused:
            launch.prepare(module_run, folder, resume=False, overwrite=True)
        assert any(name.split("/")[0] in str(refused.value) for name in users) and "--out" in str(refused.value)
        with pytest.raises(ConfigError):
            run_folder.remove(folder)
        assert files(Path(temporary)) == before


@pytest.mark.parametrize("name", FOREIGN)
def test_each_foreign_name_alone_is_refused(tmp_path, name):
    folder = write(tmp_path / "run", [*OURS, name])
    assert run_folder.foreign(folder)
    with pytest.raises(ConfigError, match=r"not written by icrl-dist: move that away"):
        run_folder.remove(folder)
    assert (folder / name).read_text() == name


def test_a_folder_with_our_files_only_is_removed(tmp_path):
    folder = write(tmp_path / "run", OURS)
    assert run_folder.foreign(folder) == []
    run_folder.remove(folder)
    assert not folder.exists()
    run_folder.remove(folder)


@pytest.mark.parametrize("place", ["run.toml", "report", "dataset/segment-000000.frames", "checkpoints"])
def test_links_are_not_followed(tmp_path, module_run, place):
    outside = write(tmp_path / "outside", ["version-0000.npz", "online.json"])
    folder = write(tmp_path / "run", ["run.toml", "env.json"])
    (folder / place).parent.mkdir(exist_ok=True)
    (folder / place).unlink(missing_ok=True)
    (folder / place).symlink_to(outside / "online.json" if "." in place else outside)
    before = files(tmp_path)
    with pytest.raises(ConfigError, match=place):
        launch.prepare(module_run, folder, resume=False, overwrite=True)
    (tmp_path / "link").symlink_to(outside)
    with pytest.raises(ConfigError, match="is a symbolic link"):
        run_folder.remove(tmp_path / "link")
    (tmp_path / "link").unlink()
    assert files(tmp_path) == before


def test_a_run_file_alone_is_no_run(tmp_path, module_run):
    folder = write(tmp_path / "run", ["run.toml"])
    with pytest.raises(ConfigError, match="holds no run"):
        launch.prepare(module_run, folder, resume=False, overwrite=True)
    assert files(folder) == {"run.toml": b"run.toml"}


def test_folders_that_cannot_be_run_folders_are_refused(tmp_path, module_run, monkeypatch):
    home, current = tmp_path / "home", tmp_path / "work" / "current"
    home.mkdir()
    write(current, ["run.toml", "env.json"])
    monkeypatch.setenv("HOME", str(home))
    monkeypatch.chdir(current)
    write(tmp_path, ["file"])
    (tmp_path / "link").symlink_to(current)
    (tmp_path / "dangling").symlink_to(tmp_path / "none")
    before = files(tmp_path)
    refused = {
        "/": "contains the current folder",
        str(home): "is or contains the home folder",
        str(current): "an empty --out",
        str(current.parent): "current folder",
        str(current / "x" / ".."): "ends in ..",
        str(tmp_path / "file"): "is a file",
        str(tmp_path / "link"): f"is a symbolic link; name the folder itself, {current}",
        str(tmp_path / "dangling"): "is a symbolic link",
    }
    for out, why in refused.items():
        for overwrite in (True, False):
            with pytest.raises(ConfigError) as error:
                launch.prepare(module_run, Path(out), resume=False, overwrite=overwrite)
            assert f"--out {out}: " in str(error.value) and why in str(error.value)
    assert files(tmp_path) == before


@pytest.mark.parametrize("spelling", ["parent", "parent/../parent", "other/parent", "parent/inside", "."])
def test_the_folder_of_a_fork_must_not_overlap_with_its_source(tmp_path, module_run, spelling):
    parent = write(tmp_path / "runs" / "parent", ["run.toml", "env.json", "checkpoints/version-0000.npz"])
    (tmp_path / "runs" / "other").symlink_to(tmp_path / "runs")
    before = files(tmp_path)
    with pytest.raises(ConfigError, match="the run of --from; use another --out"):
        launch.prepare(module_run, tmp_path / "runs" / spelling, resume=False, overwrite=True, source=(parent, 0))
    assert files(tmp_path) == before


def started(tmp_path, run):
    """The folder of a run with a checkpoint, and its files."""
    folder = tmp_path / "run"
    launch.prepare(run, folder, resume=False, overwrite=False)
    write(folder, ["checkpoints/version-0000.npz", "dataset/segment-000000.frames", ".lock"])
    return folder, files(folder)


def test_resume_and_overwrite_contradict_each_other(tmp_path, module_run):
    folder, before = started(tmp_path, module_run)
    with pytest.raises(ConfigError, match=r"--resume --overwrite: .* give one of them"):
        launch.prepare(module_run, folder, resume=True, overwrite=True)
    assert files(folder) == before


@pytest.mark.parametrize("options", [{"resume": False, "overwrite": True}, {"resume": True, "overwrite": False}])
def test_the_folder_of_an_active_run_is_not_changed(tmp_path, module_run, options):
    folder, before = started(tmp_path, module_run)
    stamp = (folder / "env.json").stat().st_mtime_ns
    with hold(folder), pytest.raises(ConfigError, match=r"run: a run is active in this folder; end it, or use another --out"):
        launch.prepare(module_run, folder, **options)
    assert files(folder) == before and (folder / "env.json").stat().st_mtime_ns == stamp
    with launch.prepare(module_run, folder, **options):
        pass


def test_the_old_run_is_removed_at_the_first_checkpoint_and_not_before(tmp_path, module_run):
    folder, before = started(tmp_path, module_run)
    events = list[dict[str, Any]]()
    with launch.prepare(module_run, folder, resume=False, overwrite=True) as transaction:
        report, aside = transaction.commit_at_checkpoint(events.append), run_folder.aside_of(folder)
        report({"event": "progress", "version": -1})
        assert replaced(folder) == before
        report({"event": "progress", "version": 0})
        assert replaced(folder) == before, "the event alone is not enough"
        with pytest.raises(ConfigError, match="a run is active"):
            launch.prepare(module_run, folder, resume=False, overwrite=True)
        write(folder, ["checkpoints/version-0000.npz"])
        report({"event": "progress", "version": 0})
        assert not aside.exists() and len(events) == 3
    assert folder.is_dir() and not transaction.rolled_back


@pytest.mark.parametrize("error", [KeyboardInterrupt, launch.TrainInterrupted, ConfigError])
def test_the_old_run_is_restored_if_the_new_run_ends_before_its_first_checkpoint(tmp_path, module_run, error):
    folder, before = started(tmp_path, module_run)
    transaction = launch.prepare(module_run, folder, resume=False, overwrite=True)
    with pytest.raises(error), transaction:
        write(folder, ["dataset/segment-000000.frames", "learner.log", "crashes/w0-1.json"])
        raise error
    assert transaction.rolled_back and files(tmp_path) == {f"run/{name}": content for name, content in before.items()}


def test_the_new_run_stays_after_its_first_checkpoint_or_a_successful_end(tmp_path, module_run):
    for checkpoint in (True, False):
        folder, _ = started(tmp_path / str(checkpoint), module_run)
        with pytest.raises(ConfigError) if checkpoint else contextlib.nullcontext():  # noqa: SIM117
            with launch.prepare(module_run, folder, resume=False, overwrite=True):
                write(folder, ["learner.log"])
                if checkpoint:
                    write(folder, ["checkpoints/version-0000.npz"])
                    raise ConfigError("later")
        assert (folder / "learner.log").exists() and [path.name for path in folder.parent.iterdir()] == ["run"]
        assert (folder / "checkpoints").exists() == checkpoint


def test_no_run_is_removed_if_the_new_folder_contains_a_user_file(tmp_path, module_run):
    folder, before = started(tmp_path, module_run)
    events = list[dict[str, Any]]()
    with pytest.raises(ConfigError), launch.prepare(module_run, folder, resume=False, overwrite=True) as transaction:
        transaction.commit_at_checkpoint(events.append)
        write(folder, ["notes.md"])
        raise ConfigError("it failed")
    assert not transaction.rolled_back and (folder / "notes.md").exists() and replaced(folder) == before
    assert str(run_folder.aside_of(folder)) in events[0]["text"] and "notes.md" in events[0]["text"]


def killed(tmp_path, run):
    """The folders that a command leaves if it is killed while it replaces a run."""
    folder, before = started(tmp_path, run)
    known(launch.prepare(run, folder, resume=False, overwrite=True)._lock).close()
    return folder, run_folder.aside_of(folder), before


@pytest.mark.parametrize("options", [(False, False), (True, False), (False, True)])
def test_after_a_kill_both_runs_are_kept_and_named_with_the_remedy(tmp_path, module_run, options):
    folder, aside, old = killed(tmp_path, module_run)
    before = files(tmp_path)
    with pytest.raises(ConfigError) as refused:
        launch.prepare(module_run, folder, *options)
    assert f"delete {folder} to restore the old run, or {aside} to keep the new run" in str(refused.value)
    assert files(tmp_path) == before
    run_folder.remove(folder)  # the remedy
    launch.prepare(module_run, folder, resume=True, overwrite=False)
    assert files(folder) == old and not aside.exists()


def test_after_a_kill_between_checkpoint_and_removal_the_new_run_stays(tmp_path, module_run):
    folder, aside, _ = killed(tmp_path, module_run)
    write(folder, ["checkpoints/version-0000.npz"])
    launch.prepare(module_run, folder, resume=True, overwrite=False)
    assert not aside.exists() and (folder / "checkpoints").exists()


def test_after_a_kill_during_the_removal_the_old_run_is_not_restored(tmp_path, module_run):
    folder, aside, _ = killed(tmp_path, module_run)
    (aside / "run.toml").unlink()
    run_folder.remove(folder)
    launch.prepare(module_run, folder, resume=False, overwrite=False)
    assert not aside.exists() and sorted(path.name for path in folder.iterdir()) == ["env.json", "run.toml"]


@pytest.mark.parametrize("left", [None, (), (".replacement",), (".replacement", ".lock")])
def test_after_a_kill_before_the_new_run_wrote_anything_the_old_run_is_restored(tmp_path, module_run, left):
    folder, aside, old = killed(tmp_path, module_run)
    (folder / ".lock").touch()
    for path in folder.iterdir():
        if path.name not in (left or ()):
            path.unlink()
    if left is None:
        folder.rmdir()
    launch.prepare(module_run, folder, resume=True, overwrite=False)
    assert files(folder) == old and not aside.exists()


@pytest.mark.parametrize("options", [(False, False), (True, False), (False, True)])
def test_a_finished_run_that_the_user_moved_in_removes_no_replaced_run(tmp_path, module_run, options):
    folder, *_ = killed(tmp_path, module_run)
    run_folder.remove(folder)
    write(folder, ["run.toml", "env.json", "result.json", "checkpoints/version-0000.npz"])
    before = files(tmp_path)
    with pytest.raises(ConfigError, match="to restore the old run, or"):
        launch.prepare(module_run, folder, *options)
    assert files(tmp_path) == before


@pytest.mark.parametrize("names", [["result.json"], ["agent.npz", "run.toml"], ["checkpoints/version-0000.npz"]])
def test_a_folder_with_the_name_of_a_replaced_run_is_kept(tmp_path, module_run, names):
    folder, _ = started(tmp_path, module_run)
    aside = write(run_folder.aside_of(folder), names)
    before = files(tmp_path)
    with pytest.raises(ConfigError, match="is not a run that --overwrite replaced; move it away"):
        launch.prepare(module_run, folder, resume=False, overwrite=True)
    assert files(tmp_path) == before
    shutil.rmtree(aside)
    with launch.prepare(module_run, folder, resume=False, overwrite=True):
        pass


def test_the_removal_of_a_replaced_run_is_finished_after_each_possible_interruption(tmp_path, module_run, monkeypatch):
    unlink, rmdir = Path.unlink, Path.rmdir
    for last in range(1, 30):
        folder, aside, _ = killed(tmp_path / str(last), module_run)
        write(folder, ["checkpoints/version-0000.npz"])
        count = iter(range(last))

        def at_most(do, count=count):
            def step(path, **options):
                if next(count, None) is None:
                    raise OSError(5, "killed")
                do(path, **options)

            return step

        monkeypatch.setattr(Path, "unlink", at_most(unlink))
        monkeypatch.setattr(Path, "rmdir", at_most(rmdir))
        with contextlib.suppress(OSError):
            run_folder.recover(folder)
        monkeypatch.undo()
        monkeypatch.setattr(run_folder, "WAIT_S", 0.05)
        if not aside.exists():
            break
        new = files(folder)
        launch.prepare(module_run, folder, resume=True, overwrite=False)
        assert not aside.exists() and new.items() <= files(folder).items() | {"env.json": new["env.json"]}.items()
    assert last > 3, "each of the files was the last one removed before the kill"


def test_a_full_disk_at_the_start_of_a_replacement_restores_the_old_run(tmp_path, module_run, monkeypatch):
    folder, before = started(tmp_path, module_run)

    def full(path, **options):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(Path, "mkdir", full)
    with pytest.raises(ConfigError, match="No space left"):
        launch.prepare(module_run, folder, resume=False, overwrite=True)
    monkeypatch.undo()
    assert files(tmp_path) == {f"run/{name}": content for name, content in before.items()}


def test_a_chaos_campaign_removes_only_its_own_files(tmp_path, module_run):
    folder = write(tmp_path / "undisturbed", [*OURS, "notes.md"])
    training = Training("smoke", module_run, (), folder, 1, 1.0)
    training.log.touch()
    before = files(tmp_path)
    with pytest.raises(ConfigError, match=r"notes\.md"):
        campaign._clear(training)
    assert files(tmp_path) == before
    (folder / "notes.md").unlink()
    campaign._clear(training)
    assert not any(tmp_path.iterdir())


def forked(folder, version):
    """Make the run in the folder a fork of another run, with the versions up to this one."""
    write(folder, [f"checkpoints/version-{n:04d}.npz" for n in range(version + 1)])
    (folder / "fork.json").write_text(json.dumps({"version": version}))


def test_the_versions_that_a_fork_starts_from_are_no_checkpoint_of_its_own(tmp_path, module_run, monkeypatch):
    folder, before = started(tmp_path, module_run)
    monkeypatch.setattr(launch, "fork", lambda source, version, run, folder: forked(folder, version))
    given: dict[str, Any] = {"resume": False, "overwrite": True, "source": (tmp_path / "parent", 1)}
    with pytest.raises(KeyboardInterrupt), launch.prepare(module_run, folder, **given) as transaction:
        transaction.commit_at_checkpoint(lambda event: None)({"event": "progress", "version": 1})
        raise KeyboardInterrupt
    assert transaction.rolled_back and files(folder) == before
    known(launch.prepare(module_run, folder, **given)._lock).close()  # killed
    with pytest.raises(ConfigError, match="was killed"):
        launch.prepare(module_run, folder, resume=True, overwrite=False)
    assert replaced(folder) == before
    write(folder, ["checkpoints/version-0002.npz"])
    launch.prepare(module_run, folder, resume=True, overwrite=False)
    assert not run_folder.aside_of(folder).exists()


@pytest.mark.parametrize("record", [None, "{", "{}"])
@pytest.mark.parametrize("run_file", [False, True])
def test_after_a_kill_during_a_fork_the_old_run_is_never_removed(tmp_path, module_run, record, run_file):
    folder, _, before = killed(tmp_path, module_run)
    forked(folder, 1)  # the checkpoints of the parent are linked
    (folder / "fork.json").unlink() if record is None else (folder / "fork.json").write_text(record)
    if not run_file:
        (folder / "run.toml").unlink()
    elif record is None:
        return  # that is an ordinary run with checkpoints of its own
    for resume, overwrite in ((False, False), (True, False), (False, True)):
        with pytest.raises(ConfigError, match="was killed"):
            launch.prepare(module_run, folder, resume, overwrite)
    assert replaced(folder) == before
    run_folder.remove(folder)  # the remedy
    launch.prepare(module_run, folder, resume=True, overwrite=False)
    assert files(folder) == before


def test_a_kill_while_a_fork_is_made_restores_the_old_run(tmp_path, module_run, monkeypatch):
    class Killed(BaseException):
        """Stands for SIGKILL: nothing is cleaned up."""

    folder, before = started(tmp_path, module_run)

    def half(source, version, run, folder):
        forked(folder, version)
        (folder / "fork.json").unlink()
        raise Killed

    monkeypatch.setattr(launch, "fork", half)
    monkeypatch.setattr(run_folder, "remove", lambda folder: None)
    monkeypatch.setattr(run_folder.FolderTransaction, "roll_back", lambda self: self._lock.close())
    with pytest.raises(Killed):
        launch.prepare(module_run, folder, resume=False, overwrite=True, source=(tmp_path / "parent", 1))
    monkeypatch.undo()
    launch.prepare(module_run, folder, resume=True, overwrite=False)
    assert files(folder) == before


def test_an_interrupted_removal_leaves_no_run(tmp_path, monkeypatch):
    folder = write(tmp_path / "run", OURS)
    unlink, removed = Path.unlink, list[Path]()

    def once(path, missing_ok=False):
        if removed:
            raise OSError("interrupted")
        removed.append(path)
        unlink(path, missing_ok)

    monkeypatch.setattr(Path, "unlink", once)
    with pytest.raises(OSError, match="interrupted"):
        run_folder.remove(folder)
    assert removed == [folder / "run.toml"] and not removed[0].exists()


def test_the_lock_is_taken_on_the_file_that_is_in_the_folder_now(tmp_path, monkeypatch):
    """Another process may replace the folder between opening and locking its lock file."""
    folder = write(tmp_path / "run", ["run.toml"])
    flock, replaced = fcntl.flock, list[Path]()

    def late(file, how):
        if not replaced:
            replaced.append((folder / ".lock").rename(tmp_path / "gone"))
        flock(file, how)

    monkeypatch.setattr(fcntl, "flock", late)
    with hold(folder) as file:
        assert replaced and os.path.samestat(os.fstat(file.fileno()), (folder / ".lock").stat())


@pytest.mark.parametrize("out", ["y" * 241, "/".join(["x" * 200] * 19)])
def test_a_path_too_long_for_the_names_in_a_run_folder_is_refused(tmp_path, out):
    with pytest.raises(ConfigError, match=r"too long \(\d+ bytes\); a folder's name may have 240 bytes"):
        run_folder.check_place(tmp_path / out)
    run_folder.check_place(tmp_path / ("y" * 240))
