"""``icrl-dist report``: its numbers against slow loops, its verdicts on known effects, its files, and what it refuses."""

from __future__ import annotations

import base64
import csv
import json
import math
import re

import numpy as np
import pyarrow.parquet as pq
import pytest

from icrl_dist.cli import main
from icrl_dist.config.run import ConfigError
from icrl_dist.results import rows as result_rows
from icrl_dist.results.claims import questions
from icrl_dist.results.claims.findings import together, verdict
from icrl_dist.results.claims.icaa import closed
from icrl_dist.results.figures import catalog, reading
from icrl_dist.results.figures.reading import Rows, files_of
from icrl_dist.results.figures.selection import Rules, study
from icrl_dist.results.paper_report import report
from icrl_dist.results.statistics import Interval
from icrl_dist.storage.files import StoreError
from tests.results.synthetic import AGENTS, Sweep, plain, small, write

WIND = {name: AGENTS[name] for name in ("dpt", "icag", "icaa", "exact")}


@pytest.fixture(scope="module")
def sweep(tmp_path_factory):
    """The rows of a sweep with the plain setting ``room`` and with ``wind``."""
    return write(tmp_path_factory.mktemp("sweep"), Sweep(plain, AGENTS, "room"), Sweep(plain, WIND, "wind"))


@pytest.fixture(scope="module")
def frame(sweep):
    return pq.read_table(sweep).to_pandas()


def slow(frame, variant, agent, p, prior, episodes, suite="online", data=""):
    """The mean return over the last episodes, by a loop over the rows, and the mean certified return."""
    total = worst = count = 0.0
    last = max(frame[frame["suite"] == suite]["episode"]) - episodes
    for row in frame[(frame["setting"] == "room") & (frame["variant"] == variant)].to_dict("records"):
        same = (row["agent"], row["p"], row["prior"], row["suite"], row["data"]) == (agent, p, prior, suite, data)
        if same and row["episode"] > last:
            total, worst, count = total + row["return"], worst + row["certified"], count + 1
    return total / count, worst / count


ENOUGH = {"icag": ("t0",), "icag-k4": ("t0",), "icag-k16": ("t0",), "exact": ("oracle",)}


def point(panels, name, series, x):
    panel = next(panel for panel in panels if panel.name == name)
    return next(p for one in panel.series if one.name == series for p in one.points if p.x == x)


def test_the_numbers_of_the_figures_are_those_of_slow_loops(sweep, frame, monkeypatch):
    monkeypatch.setattr(reading, "_BATCH", 700)  # rows of one arm in several batches
    rows = Rows([sweep])

    def check(found, expected):
        assert found.value.value == pytest.approx(expected[0]) and found.certified == pytest.approx(expected[1])
        assert found.value.low < found.value.value < found.value.high

    three = catalog.numbers("3", rows, "room", Rules())
    assert [panel.name for panel in three] == ["3a", "3b", "3c", "3c (all)", "3d"]
    check(point(three, "3c", "ICAG", 0.4), slow(frame, "icag", "t0", 0.4, "uniform", 5))
    check(point(three, "3c (all)", "ICAA", 0.6), slow(frame, "icaa", "t2", 0.6, "uniform", 6))
    check(point(three, "3d", "oracle", 6), slow(frame, "exact", "oracle", 0.2, "unseen", 1))
    check(point(three, "3a", "DPT", "random data"), slow(frame, "dpt", "t0", 0.0, "uniform", 1, "offline", "random"))
    check(point(three, "3a", "oracle", "expert data"), slow(frame, "exact", "oracle", 0.0, "uniform", 1, "offline"))
    check(
        point(catalog.numbers("6c", rows, "room", Rules()), "6c", "ICAG, K = 16", 0.2),
        slow(frame, "icag-k16", "t0", 0.2, "uniform", 5),
    )
    check(
        point(catalog.numbers("7a", rows, "room", Rules()), "7a", "ICAA, T^1", 6), slow(frame, "icaa", "t1", 0.0, "uniform", 1)
    )
    two = catalog.numbers("2", rows, "room", Rules())
    before, after = (slow(frame, "dpt", "t0", p, "uniform", 5) for p in (0.0, 0.2))
    check(point(two, "2", "DPT", "lost"), (before[0] - after[0], before[1] - after[1]))
    strength = catalog.numbers("strength", rows, None, Rules())
    assert {panel.name for panel in strength} == {"strength, wind", "strength, wind (all)"}


def test_captions_say_what_was_resampled(sweep):
    (panel,) = catalog.numbers("3d", Rows([sweep]), "room", Rules())
    assert (
        "95% interval over 6 training seeds, 4 tasks, 2 evaluations of each with an adversary draw of its own" in panel.caption
    )
    assert (
        "training seeds 0 to 5, 6 splits of the tasks, 2 adversary draws a task; each training is drawn with all its tasks"
        in panel.caption
    )


def test_an_interval_over_seeds_covers_the_true_effect_and_is_paired(sweep):
    """The common term of a seed has a deviation of 3, and would hide an effect of 2.5 of unpaired seeds."""
    found = {claim.number: claim for claim in questions.claims(study(Rows([sweep]), "room", Rules()), {})}
    (advantage,) = (one for one in found[4].findings)
    assert advantage.effect.low < 5.0 < advantage.effect.high  # ``plain``: 5 per unit of p
    one = next(one for one in found[2].findings if one.comparison == "ICAA - DPT, p = 0.4, uniform")
    assert one.effect.low < 3.0 * 0.7 < one.effect.high and one.effect.high - one.effect.low < 0.5


def test_true_effects_and_equality_within_the_margin_are_held(sweep):
    rows = Rows([sweep])
    found = {claim.number: claim for claim in questions.claims(study(rows, "room", Rules()), {})}
    assert [found[n].verdict for n in (1, 2, 3, 4, 6, 7, 8)] == ["held"] * 6 + ["not decidable"]
    assert {one.verdict for one in found[7].findings if "K = 4" in one.comparison} == {"held"}
    assert {one.verdict for one in found[7].findings if "K = 16" in one.comparison} == {"held"}
    assert [claim.number for claim in questions.claims(study(rows, "wind", Rules()), {})] == [1, 2, 3, 4, 6, 8]


def test_claims_are_read_at_the_strong_disturbances_that_must_be_inferred(tmp_path):
    levels = (0.0, 0.2, 0.4, 0.6, 0.8, 1.0)
    file = write(
        tmp_path,
        Sweep(plain, WIND, "wind", levels=levels, goals=2, evaluations=1, episodes=2),
        Sweep(plain, WIND, "room", levels=levels, goals=2, evaluations=1, episodes=2),
    )
    for setting, strengths in (("wind", (0.2, 0.4, 0.6, 0.8, 1.0)), ("room", (0.2, 0.4, 0.6))):
        found = {claim.number: claim for claim in questions.claims(study(Rows([file]), setting, Rules()), {})}
        names = [one.comparison for one in found[2].findings if one.comparison.endswith("uniform")]
        assert names == [f"{pair}, p = {p:g}, uniform" for p in strengths for pair in ("ICAG - ICAA", "ICAA - DPT")]
    (table,) = [
        sheet
        for part in report(file, setting="wind", claims=True, out=tmp_path / "out").sections
        for sheet in part.sheets
        if "each round" in sheet.title
    ]
    assert [row[0] for row in table.rows if row[0]] == ["0", *(f"{p:g}, uniform" for p in levels[1:]), "0.2, unseen"]


def test_a_null_effect_is_not_shown_and_an_opposite_one_not_held(tmp_path):
    def mean(variant, agent, p):
        return 70.0 - 60.0 * p - (4.0 if variant == "icaa" else 0.0)

    rows = Rows([write(tmp_path, small(tmp_path, mean=mean, levels=(0.0, 0.2, 0.4, 0.6)), offline=False)])
    found = {claim.number: claim for claim in questions.claims(study(rows, None, Rules()), {})}
    assert found[3].verdict == found[4].verdict == "not shown"
    assert found[2].verdict == "not held"
    assert {one.verdict for one in found[2].findings if one.comparison.startswith("ICAG")} == {"held"}
    assert found[5].verdict == "not decidable"
    assert "room/dpt, seeds 0 to 5 (evaluated at offline p = 0 random data)" in found[5].findings[0].reason


@pytest.mark.parametrize(
    ("more", "expected"), [(0.0, "held"), (0.4, "held"), (0.7, "not shown"), (3.0, "not held"), (-3.0, "held")]
)
def test_k_8_suffices_unless_k_16_is_above_it_by_the_margin(tmp_path, more, expected):
    """The oracle's return is 70 at every p, so the margin is 0.7; K = 4 is as good as K = 8 and decides nothing."""

    def mean(variant, agent, p):
        return 70.0 if variant == "exact" else 50.0 + more * (variant == "icag-k16")

    levels = (0.0, 0.2, 0.4, 0.6)
    rows = Rows([write(tmp_path, small(tmp_path, mean=mean, levels=levels, agents=ENOUGH), offline=False)])
    claim = {one.number: one for one in questions.claims(study(rows, None, Rules()), {})}[7]
    found = {one.comparison: one for one in claim.findings}
    assert len(found) == 10 and claim.verdict == expected
    assert {one.verdict for one in claim.findings if one.needed} == {expected}
    assert {one.verdict for one in claim.findings if not one.needed} == {"not shown"}
    one = found["K = 16 less K = 8, p = 0.2, uniform"]
    top, _ = slow(pq.read_table(tmp_path / "rows.parquet").to_pandas(), "exact", "oracle", 0.2, "uniform", 5)
    assert one.margin == pytest.approx(0.01 * top) and one.effect.low < more < one.effect.high
    (section, *_) = report(tmp_path / "rows.parquet", claims=True, out=tmp_path / "report").sections
    assert "1% of the oracle's return at that p" in section.sheets[0].caption
    cells = [row for row in section.sheets[0].rows if row[1].startswith("K = ")]
    assert all(re.search(r", margin 0\.(6|7)\d$", row[1]) for row in cells if "K = 16" in row[1])
    assert all(row[-1] == "not shown, beside" for row in cells if "K = 4" in row[1])


def test_k_8_suffices_is_not_decidable_without_the_oracle(tmp_path):
    agents = {name: of for name, of in ENOUGH.items() if name != "exact"}
    rows = Rows([write(tmp_path, small(tmp_path, levels=(0.0, 0.2, 0.4, 0.6), agents=agents), offline=False)])
    claim = {one.number: one for one in questions.claims(study(rows, None, Rules()), {})}[7]
    assert claim.verdict == "not decidable"
    assert {one.reason for one in claim.findings if one.needed} == {
        "rows are missing; these runs make them: room/exact, seeds 0 to 5"
    }


@pytest.mark.parametrize(("seeds", "noted"), [(9, True), (10, False)])
def test_the_caption_says_that_dpt_icag_and_icaa_want_ten_seeds(tmp_path, seeds, noted):
    """Of the other comparisons, such as what a method loses, five are enough."""
    path = write(tmp_path, small(tmp_path, seeds=seeds, levels=(0.0, 0.2, 0.4, 0.6)), offline=False)
    caption = report(path, claims=True, out=tmp_path / "report").sections[0].sheets[0].caption
    found = questions.claims(study(Rows([path]), None, Rules()), {})
    main = [one for claim in found for one in claim.findings if one.seeds and claim.number in (2, 3, 4, 8)]
    main += [one for one in found[5].findings if one.seeds and one.comparison.startswith("ICAG")]
    assert (f"{len(main)} comparisons of DPT, ICAG and ICAA with each other have fewer than the 10" in caption) == noted
    assert ("fewer than the 10 training seeds" in caption) == noted and "Warning" not in caption


def test_captions_warn_of_trainings_that_share_a_split(tmp_path):
    columns = {name: {"split_seed": 7} for name in ("dpt", "icag", "icaa", "mix_dpt", "prompt_dt")}
    path = write(tmp_path, small(tmp_path, columns=columns, levels=(0.0, 0.2, 0.4, 0.6)), offline=False)
    first, *_ = report(path, claims=True, out=tmp_path / "report").sections
    assert "trainings share a split of the tasks" in first.sheets[0].caption
    (panel, *_) = catalog.numbers("3c", Rows([path]), None, Rules(partial=True))
    assert "1 split of the tasks (shared by trainings; each should have its own)" in panel.caption
    unknown = {name: {"split_seed": None} for name in columns}
    path = write(tmp_path, small(tmp_path, columns=unknown, levels=(0.0, 0.2, 0.4, 0.6)), offline=False)
    first, *_ = report(path, claims=True, out=tmp_path / "report").sections
    assert "share a split" not in first.sheets[0].caption


def test_methods_that_repeat_actions_fail_on_random_contexts_where_dpt_and_icag_are_above_them(sweep):
    """The claim is about prompt-DT and ARDT: that DPT has more with expert data than with random data decides nothing."""
    found = {claim.number: claim for claim in questions.claims(study(Rows([sweep]), "room", Rules()), {})}[5]
    assert found.text.startswith("DT-based methods")
    effects = {one.comparison: (one.effect.value, one.verdict) for one in found.findings}
    value, found_so = effects["ICAG - prompt-DT, random data"]
    assert found_so == "held" and value == pytest.approx(1.35, abs=0.2)  # ``plain``: 4.5 x 0.3
    assert effects["DPT - prompt-DT, random data"][0] == pytest.approx(-0.15, abs=0.2)  # ``plain``: DPT gains 0.5 x 0.3 less
    assert {name.split(",")[0].split(" - ")[1] for name in effects} == {"prompt-DT", "ARDT"}


def test_captions_say_what_certified_means_and_how_many_comparisons_there_are(sweep, tmp_path):
    """Also under wind: certified is about overrides there too."""
    for options in ({"figure": "2"}, {"figure": "budgets"}, {"claims": True}):
        for sheet in (
            s for part in report(sweep, setting="wind", out=tmp_path, partial=True, **options).sections for s in part.sheets
        ):
            if any("certified" in column for column in sheet.columns):
                assert "wind and permuted controls are not in it" in sheet.caption, sheet.title
    (claims, *_) = report(sweep, setting="wind", claims=True).sections
    count = sum(len(claim["findings"]) for claim in claims.data)
    assert f"not corrected for the number of comparisons ({count} here)" in claims.sheets[0].caption


def test_verdicts():
    def of(low, high, sign=1, seeds=5):
        return verdict(Interval((low + high) / 2, low, high), sign, seeds)

    assert [of(1, 2), of(-2, -1), of(-1, 1), of(0, 1)] == ["held", "not held", "not shown", "not shown"]
    assert [of(1, 2, -1), of(-2, -1, -1), of(-1, 1, -1)] == ["not held", "held", "not shown"]
    assert of(1, 2, seeds=4) == of(math.nan, math.nan) == "not decidable"
    assert together(["held", "not shown", "not decidable"]) == "not decidable"
    assert [together(["held", "not held"]), together(["held", "not shown"]), together(["held"])] == [
        "not held",
        "not shown",
        "held",
    ]


def test_the_share_of_the_gap_that_was_closed():
    rng = np.random.default_rng(0)
    first = rng.normal(50, 3, (8, 4, 2))
    noise = rng.normal(0, 0.3, (2, 8, 1, 1))
    share = closed(np.stack([first, first + 3 + noise[0], first + 6 + noise[1]]))
    assert share is not None and share.low < 0.5 < share.high and share.high - share.low < 0.2
    # Fieller: the share is r0 exactly where the interval of X - r0 Y begins or ends.
    assert closed(np.stack([first, first + 3 + noise[0], first + 0.01 * rng.normal(0, 9, (8, 1, 1))])) is None
    assert closed(np.stack([first, first + 3, first - 6])) is None


def test_the_slope_is_the_least_squares_line_of_the_differences(sweep, frame):
    found = {claim.number: claim for claim in questions.claims(study(Rows([sweep]), "room", Rules()), {})}
    levels = [0.0, 0.2, 0.4, 0.6]
    gaps = [slow(frame, "icag", "t0", p, "uniform", 5)[0] - slow(frame, "dpt", "t0", p, "uniform", 5)[0] for p in levels]
    assert found[4].findings[0].effect.value == pytest.approx(np.polyfit(levels, gaps, 1)[0])


@pytest.mark.parametrize(
    ("figure", "change", "expected"),
    [
        ("3e", {}, r"--figure 3e: no such figure; did you mean '3'\?; choose one of 2, 3, 3a"),
        ("strenght", {}, r"did you mean 'strength'"),
        (
            "6",
            {},
            r"figure 6: rows are missing; these runs make them: room/icag-k4, seeds 0 to 5; room/icag-k16, seeds 0 to 5",
        ),
        ("strength", {}, r"rows are missing; these runs make them: wind/dpt; wind/icag"),
        ("deployment", {}, r"room/icag, seeds 0 to 5, evaluated with --deploy committed"),
        ("2", {"icaa": {"optimizer_steps": 400}}, r"figure 2: optimizer_steps is 300 of room/dpt .* and 400 of room/icaa"),
        ("2", {"dpt": {"labelled_episodes": 9}}, r"labelled_episodes is 9 of room/dpt .* and 100 of room/.*--unequal-budgets"),
        ("2", {"icag": {"split_seed": 3}}, r"figure 2: split seeds are .* of room/dpt .* \(3, 3, 3, 3, 3, 3\) of room/icag"),
        ("2", {"icag": {"adversary": "{}"}}, r"test adversaries differ between room/dpt .* and room/icag"),
        ("2", {"icag": {"task": "{}"}}, r"held-out tasks differ between room/dpt .* and room/icag"),
    ],
)
def test_what_is_refused(tmp_path, capsys, figure, change, expected):
    path = write(tmp_path, small(tmp_path, columns=change), offline=False)
    assert main.main(["report", str(path), "--figure", figure, "--out", str(tmp_path / "out")]) == 2
    error = capsys.readouterr().err
    assert re.search(expected, error) and error.count("\n") == 1
    assert not (tmp_path / "out").exists()


def test_training_seeds_that_differ_are_compared_only_on_demand(tmp_path):
    few = small(tmp_path, seeds=5, agents={"icaa": ("t0", "t1")})
    many = small(tmp_path, agents=dict.fromkeys(("dpt", "icag", "mix_dpt", "prompt_dt"), ("t0",)))
    path = write(tmp_path, many, few, offline=False)
    with pytest.raises(ConfigError, match=r"training seeds are 0 to 5 of room/dpt .* and 0 to 4 of room/icaa .*--common-seeds"):
        report(path, figure="2", out=tmp_path)
    found = report(path, figure="2", out=tmp_path, common_seeds=True)
    assert "training seeds 0 to 4" in str(found) and "Only training seeds that all of these agents have" in str(found)


def test_unequal_budgets_and_missing_methods_are_shown_only_on_demand(tmp_path):
    agents = {"dpt": ("t0",), "icag": ("t0",)}
    path = write(tmp_path, small(tmp_path, agents=agents, columns={"icag": {"optimizer_steps": 9}}), offline=False)
    with pytest.raises(ConfigError, match="these runs make them: room/prompt_dt, seeds 0 to 5; room/mix_dpt"):
        report(path, figure="2", out=tmp_path)
    with pytest.raises(ConfigError, match=r"optimizer_steps is 9 of room/icag .* and 300 of room/dpt"):
        report(path, figure="2", out=tmp_path, partial=True)
    with pytest.raises(ConfigError, match="optimizer_steps is 9 of"):
        report(path, figure="2", out=tmp_path, partial=True, unequal_budgets=["labelled_episodes"])
    with pytest.raises(ConfigError, match="no such budget; did you mean 'optimizer_steps'"):
        report(path, figure="2", out=tmp_path, partial=True, unequal_budgets="optimiser_steps")
    text = str(report(path, figure="2", out=tmp_path, partial=True, unequal_budgets=["optimizer_steps"]))
    assert (
        "No rows of prompt-DT, mix-DPT, ICAA" in text and "Budgets differ: optimizer_steps is 9 of icag and 300 of dpt" in text
    )
    table = str(report(path, figure="budgets", out=tmp_path))
    assert (
        "Budgets differ: optimizer_steps (icag, dpt)" in table
        and "| dpt | dpt | 8 | 0 to 5 | 100 | 2,000 | 100 | 300 |" in table
    )


def test_rows_of_another_format_of_two_runs_and_of_several_settings_are_refused(tmp_path, sweep):
    table = pq.read_table(sweep)
    pq.write_table(table.replace_schema_metadata({result_rows._FORMAT_KEY: b"9"}), tmp_path / "old.parquet")
    with pytest.raises(StoreError, match="result rows of format 9, and this version reads formats 1 and 2"):
        report(tmp_path / "old.parquet", claims=True)
    twice = [write(tmp_path / str(i), small(tmp_path, agents={"dpt": ("t0",)}), offline=False) for i in range(2)]
    frame = pq.read_table(twice[1])
    names = frame.column("run").to_pylist()
    changed = frame.set_column(frame.column_names.index("run"), frame.schema.field("run"), [[f"{name}b" for name in names]])
    pq.write_table(changed, twice[1])
    with pytest.raises(ConfigError, match="training seed 0: run is room-dpt-0 and room-dpt-0b"):
        Rows(twice)
    rows = Rows([sweep])
    with pytest.raises(ConfigError, match="--setting rom: no rows of this setting; did you mean 'room'"):
        study(rows, "rom", Rules())
    assert study(rows, None, Rules()).setting == "room"
    with pytest.raises(ConfigError, match="nothing: no such file or folder"):
        files_of(tmp_path / "nothing")


def test_a_second_evaluation_of_an_agent_replaces_the_first(tmp_path):
    one = small(tmp_path, agents={"dpt": ("t0",)})
    two = small(tmp_path, agents={"dpt": ("t0",)}, mean=lambda variant, agent, p: 7.0, goals=3)
    paths = [write(tmp_path / str(i), of, offline=False) for i, of in enumerate((one, two))]
    for order in (paths, paths[::-1]):
        arm = study(Rows(order), None, Rules()).model("dpt", 0.0)
        assert arm is not None and arm.returns.shape == (6, 3, 1, 2)


def test_figures_pages_and_json_are_written(tmp_path, sweep, capsys):
    command = ["report", str(sweep), "--setting", "room", "--figure", "3c", "--out", str(tmp_path / "figures"), "--json"]
    assert main.main(command) == 0
    found = json.loads(capsys.readouterr().out.splitlines()[-1])
    png, table, numbers = (tmp_path / "figures" / f"figure-3c.{suffix}" for suffix in ("png", "csv", "json"))
    assert found["files"] == [str(png), str(table), str(numbers)]
    assert png.read_bytes().startswith(b"\x89PNG")
    with table.open() as file:
        lines = list(csv.DictReader(file))
    value = found["sections"][0]["numbers"][0]["series"][0]["points"][0]
    assert lines[0]["series"] == "DPT" and float(lines[0]["value"]) == pytest.approx(value["value"], rel=1e-5)
    first = png.read_bytes()
    assert main.main(command) == 0 and png.read_bytes() == first, "equal rows give equal files"


def test_the_page_needs_no_other_file_and_no_network(tmp_path):
    agents = {name: AGENTS[name] for name in ("dpt", "icag", "icaa")}
    path = write(tmp_path, small(tmp_path, agents=agents), offline=False)
    found = report(path, markdown=tmp_path / "claims.md")
    page = (tmp_path / "report" / "index.html").read_text()
    assert found.files[0] == tmp_path / "report" / "index.html"
    pictures = re.findall(r"src='data:image/png;base64,([^']+)'", page)
    assert pictures and all(base64.b64decode(one).startswith(b"\x89PNG") for one in pictures)
    assert not re.search(r"(src|href)=.(https?:|//|\w+\.)", page) and "The claims one by one" in page
    assert "figure 6: rows are missing; these runs make them: room/icag-k4, seeds 0 to 5; room/icag-k16" in page
    text = (tmp_path / "claims.md").read_text()
    assert text.startswith("## Claims") and "| claim | comparison | effect, last episodes |" in text and "certified" in text


def test_deployment_rules_are_shown_beside_each_other(tmp_path):
    agents = {"dpt": ("t0",), "icag": ("t0",)}
    exact = {"exact": ("exact:dpt", "exact:dpt-committed")}

    def mean(variant, agent, p):
        return 50.0 - 10.0 * p

    frozen = small(tmp_path, agents={**agents, **exact}, mean=mean)
    growing = small(
        tmp_path, agents=agents, mean=lambda *of: mean(*of) + 7, columns={name: {"deployment": "committed"} for name in agents}
    )
    rows = Rows([write(tmp_path, frozen, growing, offline=False)])
    panels = catalog.numbers("deployment", rows, None, Rules())
    for panel in ("deployment", "deployment (all)"):
        paper, own = (point(panels, panel, f"ICAG, {rule}", "p = 0.2").value.value for rule in ("Algorithm 1", "committed"))
        assert own - paper == pytest.approx(7, abs=0.1)
    ranks = {one.name: one.rank for one in panels[0].series}
    assert (ranks["ICAG, Algorithm 1"], ranks["ICAG, committed"]) == (0, 1), "two shades of one colour"
    assert (ranks["exact, DPT's prior"], ranks["exact, DPT's prior, committed"]) == (0, 1)
    shown = study(rows, None, Rules()).model("icag", 0.2)
    assert shown is not None and shown.key.deployment == "paper", "other figures show Algorithm 1"


def test_a_figure_with_some_panels_names_the_others(tmp_path):
    agents = {"dpt": ("t0",), "icag": ("t0",)}
    path = write(tmp_path, small(tmp_path, agents=agents), offline=False)
    text = str(report(path, figure="3", out=tmp_path, partial=True))
    assert "**3b: " in text and "**3a: " not in text
    assert "Left out: figure 3a: rows are missing; these runs make them: room/dpt, seeds 0 to 5 (evaluated at offline" in text


@pytest.mark.parametrize(
    ("options", "expected"),
    [
        (["--out", "FILE"], r"--out \S+/file: is a file; name a folder"),
        (["--claims", "--markdown", ""], r"--markdown '\.': is a folder; name a file"),
        (["--claims", "--markdown", "FOLDER"], r"--markdown '\S+': is a folder; name a file"),
    ],
)
def test_where_nothing_can_be_written_is_said_before_anything_is_made(tmp_path, capsys, options, expected):
    path = write(tmp_path, small(tmp_path, agents={"dpt": ("t0",)}), offline=False)
    (tmp_path / "file").touch()
    words = [{"FILE": str(tmp_path / "file"), "FOLDER": str(tmp_path)}.get(word, word) for word in options]
    assert main.main(["report", str(path), *words]) == 2
    error = capsys.readouterr().err
    assert re.search(expected, error) and error.count("\n") == 1


def test_a_claim_needs_five_training_seeds(tmp_path):
    rows = Rows([write(tmp_path, small(tmp_path, seeds=4, levels=(0.0, 0.2, 0.4, 0.6)), offline=False)])
    finding = questions.claims(study(rows, None, Rules()), {})[2].findings[0]
    assert finding.verdict == "not decidable" and finding.effect.low > 0
    assert finding.reason == "4 training seeds, and at least 5 are needed"
