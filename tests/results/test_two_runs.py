"""Two methods with two training seeds each: every printed number is computed again from the rows, by loops."""

from __future__ import annotations

import io
import json
import math
import re
from pathlib import Path
from types import SimpleNamespace

import pytest
from rich.console import Console

from icrl_dist import read_results
from icrl_dist.cli import main
from icrl_dist.config.random_keys import RandomKey, generator
from icrl_dist.results import statistics, tables
from icrl_dist.results.names import AgentKey, names
from tests.results.row_blocks import block, cells_of, frame, rendered, unwrapped
from tests.results.test_statistics import (
    STUDENT,
    slow_bootstrap,
    slow_improvement,
    slow_interval,
    slow_iqm,
    slow_mean,
    slow_minimum,
    slow_ratio,
)

pytestmark = pytest.mark.integration

LAST = 3
SEEDS, EPISODES, LEVELS = 2, 3, (0.0, 0.3)
TINY = (
    *("--engine", "inline", "--learner.threads", "1", "--pretrain.contexts", "70", "--pretrain.steps", "10"),
    *("--icaa.trials", "3", "--icaa.context-trials", "1", "--icaa.steps", "5", "--icaa.rounds", "1"),
    *("--evaluate.episodes", str(EPISODES), "--evaluate.seeds", str(SEEDS), "--evaluate.p", *map(str, LEVELS)),
)


@pytest.fixture(scope="module")
def runs(tmp_path_factory):
    """By method and training seed: the folder, and what ``train`` printed."""
    base, found = tmp_path_factory.mktemp("runs"), {}
    with pytest.MonkeyPatch.context() as patch:
        for method in ("icag", "icaa"):
            for seed in (0, 1):
                printed, folder = io.StringIO(), base / f"{method}-{seed}"
                console = Console(file=printed, width=250)
                patch.setattr(main, "_Console", lambda *_, console=console, **__: console)
                words = ["train", "smoke", "--method", method, "--seed", str(seed), *TINY, "--out", str(folder)]
                assert main.main(words) == 0, printed.getvalue()
                found[method, seed] = SimpleNamespace(folder=folder, printed=printed.getvalue())
    return found


def records(rows, **wanted):
    return [row for row in rows if all(row[name] == value for name, value in wanted.items())]


def nested(rows, last):
    """Mean return over the last episodes, as lists by training, task and evaluation seed."""
    answer = []
    for training in sorted({row["training_seed"] for row in rows}):
        tasks = []
        for task in sorted({row["task_index"] for row in rows}):
            here = records(rows, training_seed=training, task_index=task)
            evaluations = []
            for seed in sorted({row["evaluation_seed"] for row in here}):
                values = [row["return"] for row in records(here, evaluation_seed=seed) if row["episode"] >= EPISODES - last]
                assert len(values) == last
                evaluations.append(sum(values) / last)
            tasks.append(evaluations)
        answer.append(tasks)
    return answer


def means(scores):
    return [[sum(cell) / len(cell) for cell in training] for training in scores]


def bounds(value, values, probability=False):
    """The interval of a number over two units, trainings or tasks: all tables here have two."""
    low, high = slow_interval(value, list(values), 2)
    if probability:
        half = max(high - value, STUDENT[2] * math.sqrt(3 / 64))
        low, high = max(value - half, 0.0), min(value + half, 1.0)
    return low, high


def drawn(scores, statistic, fixed=False):
    import numpy as np

    rng = generator(0, RandomKey.RESULTS)
    return slow_bootstrap(np.array(scores), statistic, rng, statistics.RESAMPLES, crossed=True, fixed=fixed)


def with_bounds(form, value, interval):
    low, high = (form.format(bound).removesuffix("%") for bound in interval)
    return form.format(value) if math.isnan(interval[0]) else f"{form.format(value)} [{low}, {high}]"


NOT_FROZEN = (
    "exact:every-step",
    "exact:windows",
    "exact:committed",
    "exact:zeta",
    "exact:dpt-committed",
    "exact:icag-committed",
)


def slow_mean_of(rows):
    return sum(row["return"] for row in rows) / len(rows)


@pytest.mark.parametrize(("method", "seeds"), [("icag", [1]), ("icaa", [1]), ("icaa", [0, 1])])
def test_every_number_of_the_table_of_returns_follows_from_the_rows(runs, method, seeds):
    """The table of one training, and the same table of two trainings."""
    found = read_results([runs[method, seed].folder for seed in seeds])
    found = found[found.suite == "online"]
    printed = rendered(tables.returns_table(found, "trainings"))
    rows = found.to_dict("records")
    header, body = cells_of(printed)
    assert header == ["p", "agent", "ep 1", "ep 2", "ep 3", "last 3", "of oracle", "certified"]
    over = "95% interval over 2 tasks" if seeds == [1] else "95% interval over 2 training seeds, 2 tasks"
    assert f"{over}, 2 evaluations of each with an adversary draw of its own, 3 episodes an evaluation" in unwrapped(printed)
    assert ("one training: " in unwrapped(printed)) == (seeds == [1])
    agents = list(dict.fromkeys(AgentKey(row["agent"], row["deployment"], row["data"]) for row in rows))
    called = names(agents, "online", method, "darkroom")
    assert len(body) == len(agents) * len(LEVELS)
    p = None
    for index, cells in enumerate(body):
        p = float(cells[0]) if cells[0] else p
        agent = agents[index % len(agents)]
        assert p == LEVELS[index // len(agents)] and cells[1] == called[agent]
        own = records(rows, p=p, agent=agent.agent)
        for episode in range(EPISODES):
            values = [row["return"] for row in records(own, episode=episode)]
            assert len(values) == 2 * SEEDS * len(seeds) and cells[2 + episode] == f"{sum(values) / len(values):.1f}"
        scores, oracle = nested(own, LAST), nested(records(rows, p=p, agent="oracle"), LAST)
        resampled = drawn([scores, oracle], slow_ratio)
        value, share = slow_mean(means(scores)), slow_mean(means(scores)) / slow_mean(means(oracle))
        assert cells[5] == f"{value:.1f}"
        assert cells[6] == with_bounds("{:.0%}", share, bounds(share, resampled))
        values = [row["certified"] for row in own]
        assert math.isnan(sum(values)) == (agent.deployment == "committed" or agent.agent in NOT_FROZEN)
        if math.isnan(sum(values)):
            tasks = [records(own, training_seed=seed, task_index=task) for seed in seeds for task in (0, 1)]
            lowest = [min(slow_mean_of(records(of, adversary=one)) for one in {row["adversary"] for row in of}) for of in tasks]
            several = p == 0 or any(len({row["adversary"] for row in of}) > 1 for of in tasks)
            assert cells[7] == (f"{sum(lowest) / len(lowest):.1f} estimated" if several else "-")
        else:
            assert cells[7] == f"{sum(values) / len(values):.1f}"


@pytest.mark.parametrize("method", ["icag", "icaa"])
def test_train_prints_four_rows_of_the_largest_p_and_a_conclusion(runs, method):
    rows = read_results([runs[method, 1].folder])
    rows = rows[(rows.suite == "online") & (rows.p == max(LEVELS))].to_dict("records")
    header, body = cells_of(runs[method, 1].printed)
    assert header == ["agent", "return", "95%", "of oracle", "certified"]
    versions = sorted({row["agent"] for row in rows if row["policy_version"] >= 0}, reverse=True)
    assert versions[-1] == "t0" and (len(versions) == 2) == (method == "icaa")
    keys = [*versions, "random", "oracle"]
    assert [cells[1] for cells in body] == [f"{slow_mean(means(nested(records(rows, agent=key), LAST))):.2f}" for key in keys]
    newest, other = (f"T^{versions[0][1]}", "T^0" if method == "icaa" else "random")
    text = unwrapped(runs[method, 1].printed)
    assert f"{newest} compared with {other} at p = {max(LEVELS):g}: a " in text
    assert "in this training; one training seed says nothing about other seeds" in text


def test_without_a_ceiling_the_interval_is_that_of_the_return():
    returns = [[[1.0, 2.0, 6.0], [3.0, 4.0, 5.0]], [[7.0, 9.0, 8.0], [2.0, 1.0, 0.0]]]
    header, (cells,) = cells_of(rendered(tables.returns_table(frame(block(returns)), "")))
    assert header[-1] == "last 3"
    scores = [[[sum(evaluation) / 3 for evaluation in task] for task in returns]]
    value = slow_mean(means(scores))
    assert cells[-1] == with_bounds("{:.1f}", value, bounds(value, drawn([scores], slow_mean)))


def test_every_number_of_result_json_follows_from_the_rows(runs):
    folder = runs["icaa", 0].folder
    rows = records(read_results(folder).to_dict("records"), suite="online")
    result = json.loads((folder / "result.json").read_text())
    assert len(result["rows"]) == 13 * len(LEVELS)
    for numbers_of in result["rows"]:
        own = records(rows, p=numbers_of["p"], agent=numbers_of["key"], deployment=numbers_of["deployment"])
        for episode in range(EPISODES):
            here = records(own, episode=episode)
            by_seed = [sum(row["return"] for row in records(here, evaluation_seed=seed)) / 2 for seed in range(SEEDS)]
            mean = sum(by_seed) / SEEDS
            deviation = math.sqrt(sum((one - mean) ** 2 for one in by_seed) / (SEEDS - 1))
            assert numbers_of["episodes"][episode] == round(mean, 3)
            assert numbers_of["standard_error"][episode] == round(deviation / math.sqrt(SEEDS), 3)
        optimum = [sum(one["optimum"] for one in records(own, task_index=t, episode=0)) / SEEDS for t in (0, 1)]
        assert numbers_of["optimum"] == round(sum(optimum) / 2, 3)
        assert numbers_of["last5"] == round(slow_mean(means(nested(own, LAST))), 3)
        assert numbers_of["last5_over_optimum"] == round(slow_mean(means(nested(own, LAST))) / (sum(optimum) / 2), 4)
        expected = bounds(slow_mean(means(nested(own, LAST))), drawn([nested(own, LAST)], slow_mean))
        assert numbers_of["last5_interval"] == pytest.approx(expected, rel=1e-4, abs=0.0011)


def test_the_labels_that_training_reports_follow_from_the_rows(runs):
    run = runs["icaa", 0]
    rows = records(read_results(run.folder).to_dict("records"), suite="label_quality")
    reported = [json.loads(line) for line in (run.folder / "metrics.jsonl").read_text().splitlines()]
    reported = [row for row in reported if row["stage"] == "labels"]
    assert [row["step"] for row in reported] == [0, 1]
    for row in reported:
        own = records(rows, policy_version=row["step"])
        assert {one["agent"] for one in own} == {f"t{row['step']}"}
        variations = {(one["task_index"], one["adversary_index"]): one for one in own}
        rated = [one["agreement"] for one in variations.values() if not math.isnan(one["agreement"])]
        assert row["agreement"] == pytest.approx(sum(rated) / len(rated))
        early = [one["return"] for one in own if one["episode"] < 2]
        late = [one["return"] for one in own if one["episode"] >= 2]
        assert row["context_return"] == pytest.approx(sum(early) / len(early))
        assert row["label_return"] == pytest.approx(sum(late) / len(late))
        assert row["optimum"] == pytest.approx(sum(one["optimum"] for one in variations.values()) / len(variations))


def test_every_number_of_a_comparison_follows_from_the_rows(runs):
    frames = [read_results([runs[method, seed].folder for seed in (0, 1)]) for method in ("icag", "icaa")]
    text = rendered(tables.compare(*frames, names=("ICAG", "ICAA"), last=LAST))
    header, body = cells_of(text)
    assert header == ["p", "statistic", "ICAG", "compared", "its value", "effect", "95%", "verdict"]
    assert "95% interval over 2 training seeds, 2 tasks, 2 evaluations of each with an adversary draw of its own" in unwrapped(
        text
    )
    assert len(body) == 5 * len(LEVELS)
    for level, p in enumerate(LEVELS):
        newest = []
        for frame_of in frames:
            rows = records(frame_of.to_dict("records"), suite="online", p=p)
            version = max(row["policy_version"] for row in rows)
            newest.append(nested(records(rows, policy_version=version), LAST))
        first, second = map(means, newest)
        resampled = drawn(
            newest,
            lambda x, y: (
                slow_mean(y) - slow_mean(x),
                slow_iqm(y) - slow_iqm(x),
                math.nan,
                slow_ratio(y, x) - 1,
                slow_improvement(y, x),
            ),
        )
        resampled[:, 2] = drawn(newest, lambda x, y: slow_minimum(y) - slow_minimum(x), fixed=True)
        single = [(of(first), of(second)) for of in (slow_mean, slow_iqm, slow_minimum)]
        effects = [two - one for one, two in single] + [slow_ratio(second, first) - 1, slow_improvement(second, first)]
        forms = ["{:+.2f}"] * 3 + ["{:+.1%}", "{:.0%}"]
        for i, cells in enumerate(body[5 * level : 5 * level + 5]):
            low, high = bounds(effects[i], resampled[:, i], probability=i == 4)
            if i < 3:
                assert [cells[2], cells[4]] == [f"{value:.2f}" for value in single[i]]
            assert cells[5] == forms[i].format(effects[i])
            expected = " .. ".join(forms[i].format(bound) for bound in (low, high))
            assert cells[6] == ("-" if math.isnan(low) else expected)
            neutral = 0.5 if i == 4 else 0.0
            assert cells[7] == ("higher" if low > neutral else "lower" if high < neutral else "not shown")


def test_the_examples_of_the_page_run(runs, capsys):
    page = (Path(__file__).parents[2] / "docs" / "data.md").read_text()
    reading, trajectories, comparing = re.findall(r"```python\n(.*?)```", page, re.DOTALL)
    for example, shown in ((reading, "oracle"), (trajectories, "adapt/0/0/1/2")):
        exec(example.replace("runs/demo", str(runs["icaa", 0].folder)), {})
        assert shown in capsys.readouterr().out
    folders = {f"runs/{method}-{seed}": str(run.folder) for (method, seed), run in runs.items()}
    for name, folder in folders.items():
        comparing = comparing.replace(name, folder)
    comparing = re.sub(r', "runs/ica.-2"', "", comparing)  # two trainings of each were made
    exec(comparing, {})
    assert "not shown" in capsys.readouterr().out
