"""Result rows on disk: their columns, that files are only added, and what is refused."""

from __future__ import annotations

import json
import math
import subprocess
import sys
from collections.abc import Callable
from datetime import UTC, datetime
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

import icrl_dist
from icrl_dist import read_results, version
from icrl_dist.config.run import ConfigError
from icrl_dist.problems import registry
from icrl_dist.results import columns, evaluate, rows
from icrl_dist.results.evaluate import Agent, parameters
from icrl_dist.results.returns import returns
from icrl_dist.storage import layout
from icrl_dist.storage.files import StoreError
from tests.results.row_blocks import block

RETURNS = np.arange(12.0).reshape(2, 3, 2)


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A folder with one file of result rows."""
    rows.append(tmp_path / "results", "online", {"p": 0}, [block(RETURNS, "t0"), block(RETURNS + 100, "random")])
    return tmp_path


def test_each_episode_is_a_row_with_all_columns(folder):
    frame = read_results(folder)
    assert tuple(frame.columns) == tuple(columns.COLUMNS) and len(frame) == 24
    for row in frame[frame.agent == "random"].to_dict("records"):
        assert row["return"] == 100 + RETURNS[row["task_index"], row["evaluation_seed"], row["episode"]]
        assert json.loads(row["task"]) == {"goal": row["task_index"]}
    (file,) = (folder / "results").iterdir()
    assert set(frame.evaluation) == {file.stem} and set(frame.format) == {columns.FORMAT}
    assert set(frame.code_digest) == {version.digest()} and set(frame.package_version) == {icrl_dist.__version__}
    assert frame.optimum.isna().all() and not frame.diverged.any()


def test_the_rows_of_an_evaluation_are_its_returns(small_run, tmp_path):
    agents = {Agent(key): one for key, one in registry.of(small_run).references(small_run).items() if key != "random"}
    found = evaluate.online(small_run, agents)
    rows.append(tmp_path / "results", "online", {}, [one.block(small_run, "run", "evaluated") for one in found])
    frame = read_results(tmp_path)
    assert len(frame) == sum(one.returns.size for one in found)
    key = ["agent", "p", "task_index", "evaluation_seed", "episode"]
    by_key = {tuple(row[name] for name in key): row for row in frame.to_dict("records")}
    for one in found:
        assert one.optimum is not None
        for (task, seed, episode), value in np.ndenumerate(one.returns):
            row, variation = by_key[one.agent.key, one.p, task, seed, episode], one.variations[task][seed]
            assert row["return"] == value and row["optimum"] == one.optimum[task, seed]
            assert row["adversary_index"] == seed and json.loads(row["adversary"]) == json.loads(
                parameters(variation.adversary)
            )
            assert tuple(json.loads(row["task"])["goal"]) == variation.task.vector("goal")
            assert row["adversary_family"] == variation.adversary.kind
            assert json.loads(row["adversary"]).get("p", 0.0) == one.p
    assert {(row["run"], row["method"], row["training_seed"], row["split_seed"]) for row in by_key.values()} == {
        ("run", small_run.method, small_run.seed, 0)
    }


def test_a_second_evaluation_adds_a_file_and_changes_none(folder, monkeypatch):
    (first,) = (folder / "results").iterdir()
    before, written = first.read_bytes(), datetime(2026, 11, 30, 7, 30, tzinfo=UTC)

    class Stopped(datetime):
        @classmethod
        def now(cls, tz=None):
            return written

    monkeypatch.setattr(rows, "datetime", Stopped)  # two evaluations in one microsecond, with equal settings
    names = [rows.append(folder / "results", "online", {"p": 0}, [block(RETURNS)]).name for _ in range(3)]
    assert len({first.name, *names}) == 4 == len(list((folder / "results").iterdir()))
    assert first.read_bytes() == before
    assert {name.rsplit("-", 1)[0] for name in names} == {first.name.rsplit("-", 1)[0]}
    other = rows.append(folder / "results", "online", {"p": 0.2}, [block(RETURNS)])
    assert other.name.rsplit("-", 1)[0] != first.name.rsplit("-", 1)[0], "other settings have another digest"


@pytest.mark.parametrize("suite", ["online", "offline", "posterior", "label_quality", "experts"])
def test_the_run_folder_owns_its_files_and_what_a_kill_leaves(tmp_path, suite):
    name = rows.append(tmp_path, suite, {}, [block(RETURNS)]).name
    assert layout.owned("results", name) and layout.owned("results", f".{name}.123.part")
    assert not layout.owned("results", "mine.parquet")


def test_what_a_kill_leaves_is_not_read(folder):
    (file,) = (folder / "results").iterdir()
    (folder / "results" / f".{file.name}.123.part").write_bytes(file.read_bytes()[:100])
    assert len(read_results(folder)) == 24


def test_a_repeated_evaluation_is_read_as_a_whole_from_the_newest_file(folder):
    """No episode of the older file stays, also where the newer one has fewer evaluation seeds, episodes or tasks."""
    file = rows.append(folder / "results", "online", {"p": 1}, [block(RETURNS[:, :1, :1] + 1000, "t0")])
    rows.append(folder / "results", "online", {"p": 2}, [block(RETURNS, "t0", p=0.2), block(RETURNS, "t0", prior="unseen")])
    frame = read_results(folder)
    again = frame[(frame.agent == "t0") & (frame.p == 0) & (frame.prior == "uniform")]
    assert again["return"].tolist() == [1000.0, 1006.0] and set(again.evaluation) == {file.stem}
    assert len(frame) == 12 + 2 + 12 + 12, "other agents, strengths and priors are other evaluations"
    everything = read_results(folder, all=True)
    assert len(everything) == 24 + 2 + 24 and everything.evaluation.nunique() == 3


def test_runs_of_one_name_in_different_folders_are_different_runs(tmp_path):
    for seed in (0, 1):
        rows.append(tmp_path / str(seed) / "demo" / "results", "online", {}, [block(RETURNS, seed=seed, run="demo")])
    folders = [tmp_path / str(seed) / "demo" for seed in (0, 1)]
    assert read_results(folders).training_seed.value_counts().to_dict() == {0: 12, 1: 12}
    assert len(read_results([folders[0], folders[0]])) == 12


def test_the_rows_of_several_runs_are_read_together(folder, tmp_path):
    rows.append(tmp_path / "b" / "results", "online", {}, [block(RETURNS, seed=1)])
    frame = read_results([folder, str(tmp_path / "b")])
    assert frame.groupby("training_seed").size().to_dict() == {0: 24, 1: 12}


def rewritten(folder: Path, change: Callable[[pa.Table], pa.Table]) -> None:
    """Replace the folder's file by a changed table, as another version or another program would write it."""
    (file,) = (folder / "results").iterdir()
    table = change(pq.read_table(file))
    file.unlink()
    pq.write_table(table, file)


def other_format(table):
    return table.replace_schema_metadata({b"icrl_dist.results.format": b"3"})


def no_seeds(table):
    index = table.schema.get_field_index("training_seed")
    return table.set_column(index, pa.field("training_seed", pa.int64()), pa.nulls(len(table), pa.int64()))


def no_evaluation_seeds(table):
    index = table.schema.get_field_index("evaluation_seed")
    values = pa.array([None, *range(len(table) - 1)], pa.int64())
    return table.set_column(index, pa.field("evaluation_seed", pa.int64()), values)


def changed(name, value):
    def change(table):
        index = table.schema.get_field_index(name)
        return table.set_column(index, table.schema.field(index), pa.array([value] * len(table), pa.float64()))

    return change


@pytest.mark.parametrize(
    ("change", "expected"),
    [
        (other_format, r"result rows of format 3, and this version reads formats 1 and 2: .*repeat `icrl-dist evaluate`"),
        (lambda table: table.replace_schema_metadata(None), r"result rows of format none"),
        (lambda table: table.drop_columns(["training_seed"]), r"wrong columns \(training_seed\): move the file away"),
        (lambda table: table.append_column("mine", pa.nulls(24)), r"wrong columns \(mine\)"),
        (no_seeds, r"24 of 24 rows have no training_seed, .*move the file away, and evaluate again"),
        (no_evaluation_seeds, r"1 of 24 rows have no evaluation_seed"),
        (changed("return", math.nan), r"return is no finite number in 24 of 24 rows: move the file away, and evaluate again"),
        (changed("return", math.inf), r"return is no finite number"),
        (changed("p", math.nan), r"p is no finite number in 24 of 24 rows"),
        (changed("p", None), r"p is no finite number in 24 of 24 rows"),
    ],
)
def test_a_file_of_another_format_or_without_seeds_is_refused_in_one_line(folder, change, expected):
    rewritten(folder, change)
    with pytest.raises(StoreError, match=expected) as refused:
        read_results(folder)
    assert str(folder) in str(refused.value) and "\n" not in str(refused.value)


def as_format_1(table):
    """What version 0.2.0 wrote: without the columns that format 2 added, and ``adversary_index`` is the task."""
    index = table.schema.get_field_index("adversary_index")
    table = table.set_column(index, table.schema.field(index), table.column("task_index"))
    added = ["setting", "variant", "adversaries", "label_source", "training_episodes", "labelled_episodes"]
    table = table.drop_columns([*added, "environment_steps", "optimizer_steps", "certified"])
    return table.replace_schema_metadata({b"icrl_dist.results.format": b"1"})


def test_rows_of_format_1_are_read_with_the_new_columns(folder):
    present = read_results(folder)
    rewritten(folder, as_format_1)
    former = read_results(folder)
    assert tuple(former.columns) == tuple(columns.COLUMNS)
    assert set(former.setting) == {""} and (former.variant == former.method).all()
    unknown = ["adversaries", "label_source", "training_episodes", "labelled_episodes", "environment_steps"]
    assert former[[*unknown, "optimizer_steps", "certified"]].isna().all(axis=None)
    assert (former.adversary_index == 0).all(), "every evaluation of a task had the adversary of draw 0"
    kept = [name for name in columns.COLUMNS if name not in ("adversary_index", "evaluation")]
    assert (
        former[kept]
        .astype(object)
        .where(former[kept].notna(), None)
        .equals(present[kept].astype(object).where(present[kept].notna(), None))
    )
    assert len(returns(former)) == 2
    (file,) = (folder / "results").iterdir()
    rows.append(folder / "results", "online", {"p": 9}, [block(RETURNS, "t0", p=0.3)])
    assert len(read_results(folder)) == 24 + 12 and file.exists(), "files of both formats in one folder"


def test_training_rows_of_format_1_keep_the_number_of_their_variation(tmp_path):
    rows.append(tmp_path / "results", "experts", {}, [block(RETURNS, "expert", p=None)])
    rewritten(tmp_path, as_format_1)
    assert read_results(tmp_path).adversary_index.tolist() == read_results(tmp_path).task_index.tolist()


def test_a_file_of_format_1_with_other_columns_is_refused(folder):
    rewritten(folder, lambda table: as_format_1(table).append_column("certified", pa.nulls(24, pa.float64())))
    with pytest.raises(StoreError, match=r"wrong columns \(certified\)"):
        read_results(folder)


@pytest.mark.parametrize("content", [b"", b"garbage", None])
def test_a_damaged_file_is_refused_in_one_line(folder, content):
    (file,) = (folder / "results").iterdir()
    file.write_bytes(file.read_bytes()[:-20] if content is None else content)
    with pytest.raises(StoreError, match=r"not a file of result rows .*move it away") as refused:
        read_results(folder)
    assert "\n" not in str(refused.value)


def test_rows_without_a_seed_are_not_written(tmp_path):
    with pytest.raises(ValueError, match="column training_seed has no value in 12 of 12 rows"):
        rows.append(tmp_path, "online", {}, [{**block(RETURNS), "training_seed": None}])
    with pytest.raises(KeyError, match="sead"):
        rows.append(tmp_path, "online", {}, [{**block(RETURNS), "sead": 1}])
    for value in (np.nan, np.inf):
        with pytest.raises(ConfigError, match=r"agent t0: column return is no finite number in 1 of 2 .* problem darkroom"):
            rows.append(tmp_path, "online", {}, [block([[[1.0, value]]])])
    assert not list(tmp_path.iterdir())


def test_a_return_of_nan_ends_an_evaluation_after_its_first_episode(small_run, monkeypatch):
    problem, episodes = registry.of(small_run), []
    agents = {Agent("random"): problem.references(small_run)["random"]}
    real = type(problem).batch

    def batch(self, variations):
        env = real(self, variations)
        step = env.step

        def poor(*arguments):
            found = step(*arguments)
            return found._replace(reward=found.reward * np.nan)

        monkeypatch.setattr(env, "step", poor)
        return env

    monkeypatch.setattr(type(problem), "batch", batch)
    with pytest.raises(
        ConfigError, match=r"agent random at p = 0: the return is no finite number in .*; mend the rewards"
    ) as refused:
        evaluate.online(small_run, agents, lambda *event: episodes.append(event))
    assert not episodes and "\n" not in str(refused.value)
    with pytest.raises(ConfigError, match="the return is no finite number"):
        evaluate.offline(small_run, {})


@pytest.mark.parametrize(
    ("seed", "stored"), [(7, 7), ("north", None), ((1, 2), None), (True, None), (2**63, None), (np.int64(7), 7)]
)
def test_a_split_seed_that_is_no_number_of_64_bits_is_null(small_run, monkeypatch, tmp_path, seed, stored):
    config = SimpleNamespace(split_seed=seed)
    monkeypatch.setattr(registry, "of", lambda run: SimpleNamespace(config=config))
    rows.append(tmp_path / "results", "online", {}, [{**block(RETURNS), **evaluate.of_run(small_run, "run")}])
    frame = read_results(tmp_path)
    assert (frame.split_seed.isna().all() and stored is None) or set(frame.split_seed) == {stored}
    assert returns(frame)[0].cells[0][0][0] == stored


def test_an_unfinished_run_is_refused_and_named(folder):
    (folder / "run.toml").touch()
    with pytest.raises(ConfigError, match=r"this run is not finished: continue it with .*--resume"):
        read_results(folder)
    assert len(read_results(folder, unfinished=True)) == 24
    (folder / "result.json").write_text("{}")
    assert len(read_results(folder)) == 24


def test_a_folder_without_rows_is_refused(tmp_path):
    with pytest.raises(ConfigError, match=r"holds no result rows; `icrl-dist evaluate .*` writes some"):
        read_results(tmp_path)
    with pytest.raises(ConfigError, match="no such run folder"):
        read_results(tmp_path / "none")


def test_the_page_has_every_column():
    page = (Path(__file__).parents[2] / "docs" / "data.md").read_text()
    assert columns.document() in page, "put the output of `icrl_dist.results.columns.document()` into docs/data.md"


@pytest.mark.integration
def test_workers_and_the_learner_start_without_pandas_and_pyarrow():
    script = (
        "import sys, actors.worker, learner.service, icrl_dist.results.rows\nprint({'pandas', 'pyarrow'} & set(sys.modules))"
    )
    ran = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)
    assert ran.stdout.strip() == "set()"
