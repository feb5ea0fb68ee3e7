"""Learning curves of a run's experts against a slow loop, and the report that shows them."""

import csv
import dataclasses
import json

import numpy as np
import pytest

import icrl_dist
from icrl_dist.cli import main
from icrl_dist.config.run import dumps
from icrl_dist.experts import cache, standing
from icrl_dist.results import expert_curves, run_experts
from icrl_dist.types import NULL
from tests.experts.histories import EPISODES, HORIZON, run
from tests.jobs import do, jobs_of
from tests.optional import known

__all__ = ["run"]

pytestmark = pytest.mark.integration


@pytest.fixture
def folder(run, tmp_path):
    """A run folder whose run asks for returns that some experts reach, with the experts of its first job in the cache."""
    path = tmp_path / "run"
    path.mkdir()
    do(run, jobs_of(run)[0])
    (path / "run.toml").write_text(dumps(run))
    return path


def history_of(run, variation):
    return known(cache.load_any(variation, HORIZON, run.sac, run.seed))


def test_curves_figure_and_table_are_those_of_the_recorded_episodes(run, folder, tmp_path, capsys):
    job = jobs_of(run)[0]
    earned = [standing.earned(history_of(run, variation)) for variation in job.variations]
    bar = float(np.median(earned[::2])) + 1e-3
    asked = dataclasses.replace(run, sac=dataclasses.replace(run.sac, least_return=bar))
    (folder / "run.toml").write_text(dumps(asked))
    words = ["report", str(folder), "--experts", "--markdown", str(tmp_path / "experts.md"), "--json"]
    assert main.main(words) == 0
    answer = json.loads(capsys.readouterr().out.splitlines()[-1])
    assert sorted(path.name for path in (folder / "report").iterdir()) == [
        "experts-rows.csv",
        "experts.csv",
        "experts.json",
        "experts.png",
    ]
    with (folder / "report" / "experts-rows.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == 4 * EPISODES, "ten episodes give ten parts"
    by_kind: dict[bool, list[list[float]]] = {True: [], False: []}
    for number, variation in enumerate(job.variations):
        history, own = history_of(run, variation), rows[number * EPISODES : (number + 1) * EPISODES]
        returns = [float(sum(episode.tolist())) for episode in history.rewards]
        by_kind[variation.adversary == NULL].append(returns)
        for part, row in enumerate(own):
            assert float(row["return"]) == pytest.approx(returns[part], abs=1e-4)
            assert (float(row["step"]), row["episodes"]) == ((part + 1) * HORIZON, "1")
        assert {row["expert"] for row in own} == {f"task{number // 2}-variation{number % 2}"}
        assert json.loads(own[0]["task"]) == json.loads(json.dumps(dict(variation.task.params)))
    (panel,) = answer["sections"][0]["numbers"]
    expected = [over(by_kind[kind], axis=0) for kind in (True, False) for over in (np.mean, np.min)]
    assert [one["name"] for one in panel["series"]] == [
        f"{kind}, {name}" for kind in ("undisturbed", "disturbed") for name in ("mean", "minimum")
    ]
    for one, values in zip(panel["series"], expected, strict=True):
        np.testing.assert_allclose([point["value"] for point in one["points"]], values, atol=1e-4)
    (table,) = answer["sections"][0]["tables"]
    below = [value < bar and number % 2 == 0 for number, value in enumerate(earned)]
    assert [row[""] == "failed" for row in table["rows"]] == below and any(below)
    assert f"{sum(below)} of 4 experts" in table["caption"] and "4 experts of the run are not in the cache" in table["caption"]
    assert "Learning curves of SAC experts" in (tmp_path / "experts.md").read_text()


def test_long_trainings_have_twenty_parts_and_diverged_episodes_only_leave_gaps(run, folder):
    long = dataclasses.replace(run.sac, steps=HORIZON * 100)
    of = dataclasses.replace(run_experts.wanted(run)[0][0], sac=long)
    stored = history_of(run, of.variation)

    def made(episodes):
        rewards = np.zeros((episodes, HORIZON), np.float32)
        rewards[:, 0] = np.arange(episodes)
        others = ("actions", "observations", "adversary", "labels")
        resized = {
            name: np.resize(array, (episodes, *array.shape[1:])) for name, array in stored.arrays().items() if name in others
        }
        return expert_curves.curve(of, cache.History(**{**stored.arrays(), **resized, "rewards": rewards}), acts=True)

    whole = made(100)
    np.testing.assert_allclose(whole.returns, np.arange(100).reshape(20, 5).mean(axis=1))
    np.testing.assert_allclose(whole.steps, HORIZON * 5 * np.arange(1, 21))
    few = made(10)
    assert few.episodes.count(1) == 10 and np.isnan(few.returns).sum() == 10
    panel = expert_curves.panel([few, few], "")
    assert len(panel.series[0].points) == 10 and panel.series[0].points[-1].x == HORIZON * 100
    assert ",,0\n" in expert_curves.csv_rows([few])


@pytest.mark.parametrize(
    ("more", "expected"),
    [
        (["--claims"], "choose one of --figure, --claims and --experts"),
        (["--figure", "3"], "choose one of --figure, --claims and --experts"),
        (["another"], "2 folders were given; name one run folder"),
    ],
)
def test_one_run_folder_and_no_other_figure(folder, more, expected, capsys):
    assert main.main(["report", str(folder), *more, "--experts"]) == 2
    (line,) = capsys.readouterr().err.strip().splitlines()
    assert expected in line


def test_a_run_without_experts_in_the_cache_is_refused_with_the_command(run, small_run, tmp_path):
    for name, of, words in (("none", run, "trains the missing ones"), ("room", small_run, "trains no SAC experts")):
        (tmp_path / name).mkdir()
        (tmp_path / name / "run.toml").write_text(dumps(of))
        with pytest.raises(icrl_dist.ConfigError, match=words):
            icrl_dist.report(tmp_path / name, experts=True)
