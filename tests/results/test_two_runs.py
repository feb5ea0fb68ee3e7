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
from icrl_dist.config.run import ConfigError
from icrl_dist.results import statistics, tables
from icrl_dist.results.comparison import Comparison
from icrl_dist.results.names import AgentKey, names
from icrl_dist.results.summaries import Interval
from tests.results.row_blocks import block, frame
from tests.results.test_statistics import slow_bootstrap, slow_improvement, slow_iqm, slow_mean, slow_minimum, slow_ratio

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
                patch.setattr(main, "Console", lambda *_, console=console, **__: console)
                words = ["train", "smoke", "--method", method, "--seed", str(seed), *TINY, "--out", str(folder)]
                assert main.main(words) == 0, printed.getvalue()
                found[method, seed] = SimpleNamespace(folder=folder, printed=printed.getvalue())
    return found


def rendered(table):
    output = io.StringIO()
    Console(file=output, width=250).print(table)
    return output.getvalue()


def unwrapped(text):
    return " ".join(text.split())


def cells_of(text):
    """The cells of the body of a printed table, by row, and its header."""
    header = next(line for line in text.splitlines() if line.startswith("┃"))
    body = [line for line in text.splitlines() if line.startswith("│")]
    return [c.strip() for c in header.strip("┃").split("┃")], [[c.strip() for c in line.strip("│").split("│")] for line in body]


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


def percentiles(values):
    values = sorted(value for value in values if not math.isnan(value))
    bounds = []
    for share in (0.025, 0.975):
        place = share * (len(values) - 1)
        below = math.floor(place)
        above = min(below + 1, len(values) - 1)
        bounds.append(values[below] + (place - below) * (values[above] - values[below]))
    return bounds


def drawn(scores, statistic):
    import numpy as np

    return slow_bootstrap(np.array(scores), statistic, generator(0, RandomKey.RESULTS), statistics.RESAMPLES, crossed=True)


def numbers(text):
    return [float(number) for number in re.findall(r"-?\d+\.?\d*", text)]


@pytest.mark.parametrize(("method", "seeds"), [("icag", [1]), ("icaa", [1]), ("icaa", [0, 1])])
def test_every_number_of_the_table_of_train_follows_from_the_rows(runs, method, seeds):
    """What ``train`` printed for one training, and the same table of two trainings."""
    found = read_results([runs[method, seed].folder for seed in seeds])
    found = found[found.suite == "online"]
    printed = runs[method, 1].printed if seeds == [1] else rendered(tables.returns_table(found, "two trainings"))
    rows = found.to_dict("records")
    header, body = cells_of(printed)
    assert header == ["p", "agent", "ep 1", "ep 2", "ep 3", "last 3", "of oracle"]
    over = "95% interval over 2 tasks" if seeds == [1] else "95% interval over 2 training seeds, 2 tasks"
    assert f"{over} with their adversaries, 2 evaluations of each, 3 episodes an evaluation" in unwrapped(printed)
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
        assert cells[6] == "{:.0%} [{:.0f}, {:.0f}]".format(share, *(100 * bound for bound in percentiles(resampled)))


def test_without_a_ceiling_the_interval_is_that_of_the_return():
    returns = [[[1.0, 2.0, 6.0], [3.0, 4.0, 5.0]], [[7.0, 9.0, 8.0], [2.0, 1.0, 0.0]]]
    header, (cells,) = cells_of(rendered(tables.returns_table(frame(block(returns)), "")))
    assert header[-1] == "last 3"
    scores = [[[sum(evaluation) / 3 for evaluation in task] for task in returns]]
    low, high = percentiles(drawn([scores], slow_mean))
    assert cells[-1] == f"{slow_mean(means(scores)):.1f} [{low:.1f}, {high:.1f}]"


def test_every_number_of_result_json_follows_from_the_rows(runs):
    folder = runs["icaa", 0].folder
    rows = records(read_results(folder).to_dict("records"), suite="online")
    result = json.loads((folder / "result.json").read_text())
    assert len(result["rows"]) == 9 * len(LEVELS)
    for numbers_of in result["rows"]:
        own = records(rows, p=numbers_of["p"], agent=numbers_of["key"], deployment=numbers_of["deployment"])
        for episode in range(EPISODES):
            here = records(own, episode=episode)
            by_seed = [sum(row["return"] for row in records(here, evaluation_seed=seed)) / 2 for seed in range(SEEDS)]
            mean = sum(by_seed) / SEEDS
            deviation = math.sqrt(sum((one - mean) ** 2 for one in by_seed) / (SEEDS - 1))
            assert numbers_of["episodes"][episode] == round(mean, 3)
            assert numbers_of["standard_error"][episode] == round(deviation / math.sqrt(SEEDS), 3)
        optimum = [records(own, task_index=task)[0]["optimum"] for task in (0, 1)]
        assert numbers_of["optimum"] == round(sum(optimum) / 2, 3)
        assert numbers_of["last5"] == round(slow_mean(means(nested(own, LAST))), 3)
        assert numbers_of["last5_over_optimum"] == round(slow_mean(means(nested(own, LAST))) / (sum(optimum) / 2), 4)
        resampled = drawn([nested(own, LAST)], slow_mean)
        assert numbers_of["last5_interval"] == pytest.approx([round(bound, 3) for bound in percentiles(resampled)], abs=0.0011)


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
    assert "95% interval over 2 training seeds, 2 tasks with their adversaries, 2 evaluations of each, 3 episodes" in unwrapped(
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
                slow_minimum(y) - slow_minimum(x),
                slow_ratio(y, x) - 1,
                slow_improvement(y, x),
            ),
        )
        single = [(of(first), of(second)) for of in (slow_mean, slow_iqm, slow_minimum)]
        effects = [two - one for one, two in single] + [slow_ratio(second, first) - 1, slow_improvement(second, first)]
        forms = ["{:+.2f}"] * 3 + ["{:+.1%}", "{:.0%}"]
        for i, cells in enumerate(body[5 * level : 5 * level + 5]):
            low, high = percentiles(resampled[:, i])
            if i < 3:
                assert [cells[2], cells[4]] == [f"{value:.2f}" for value in single[i]]
            assert cells[5] == forms[i].format(effects[i])
            assert cells[6] == " .. ".join(forms[i].format(bound) for bound in (low, high))
            neutral = 0.5 if i == 4 else 0.0
            assert cells[7] == ("not shown" if low <= neutral <= high else "higher" if low > neutral else "lower")


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


def test_an_effect_is_worded_by_its_interval():
    def verdict(low, high, neutral=0.0):
        return Comparison(0.0, "mean", 1.0, 2.0, Interval((low + high) / 2, low, high), neutral).verdict

    assert [verdict(0.1, 2), verdict(-2, -0.1), verdict(-1, 2), verdict(0, 2)] == ["higher", "lower", "not shown", "not shown"]
    assert [verdict(0.4, 0.9, 0.5), verdict(0.6, 0.9, 0.5), verdict(math.nan, math.nan)] == ["not shown", "higher", "not shown"]


def test_one_training_makes_no_claim_over_seeds():
    text = rendered(tables.compare(frame(block([[[1.0]], [[2.0]]])), frame(block([[[3.0]], [[5.0]]]))))
    assert "one training: 95% interval over 2 tasks" in unwrapped(text)
    assert "it says nothing about other training seeds" in unwrapped(text) and "higher" in text


TWO = [[[1.0, 2.0]], [[3.0, 4.0]]]


@pytest.mark.parametrize(
    ("other", "expected"),
    [
        (block(TWO, seed=1), r"training seeds are \(0,\) .* and \(1,\)"),
        (block([[[1.0, 2.0]] * 2] * 2), r"evaluation seeds are \(0,\) .* and \(0, 1\)"),
        (block([[[1.0]], [[2.0]]]), r"episodes are 2 .* and 1"),
        (block(TWO[:1]), r"tasks are 2 .* and 1"),
        (block(TWO, split_seed=3), r"training seed 0, task 0: .*split seed 0, .*split seed 3"),
        (block(TWO, adversary='{"p": 0.1}'), r"rows are paired by split seed, task and adversary"),
        (block(TWO, task='{"goal": 9}'), r'task \{"goal": 9\}'),
        (block(TWO, p=0.2), r"evaluated at no p in common"),
    ],
)
def test_rows_that_cannot_be_paired_are_refused(other, expected):
    with pytest.raises(ConfigError, match=expected) as refused:
        tables.compare(frame(block(TWO)), frame(other))
    assert "\n" not in str(refused.value)


def test_rows_that_are_no_full_grid_are_refused():
    whole = frame(block(TWO))
    with pytest.raises(ConfigError, match=r"t0, p = 0: 3 rows for 1 trainings, 2 tasks, 1 evaluations and 2 episodes"):
        tables.returns_table(whole.iloc[:3], "")
    with pytest.raises(ConfigError, match="choose rows of runs with different seeds"):
        tables.returns_table(frame(block(TWO), block(TWO, run="same-seed")), "")
    with pytest.raises(ConfigError, match="method is dpt, icaa; choose one"):
        tables.returns_table(frame(block(TWO), block(TWO, "t1", method="icaa")), "")
    with pytest.raises(ConfigError, match="there are none"):
        tables.returns_table(whole.iloc[:0], "")
    with pytest.raises(ConfigError, match="needs one agent of these: random, oracle"):
        tables.compare(frame(block(TWO, "random"), block(TWO, "oracle")), whole)


def test_the_newest_model_is_compared_by_the_rule_that_it_was_trained_for():
    blocks = [block([[[value]]], "t3", deployment=rule) for value, rule in ((5.0, "committed"), (1.0, "paper"))]
    text = rendered(tables.compare(frame(block([[[4.0]]], "t0")), frame(block([[[2.0]]], "t0"), *blocks)))
    assert cells_of(text)[1][0][3:5] == ["T^3 (dpt)", "5.00"]
