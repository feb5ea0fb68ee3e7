"""The list of runs of a sweep file, and what is refused before anything is written."""

import re
from pathlib import Path

import pytest

from icrl_dist.config.run import ConfigError
from icrl_dist.storage.files import StoreError
from icrl_dist.sweeps import file, plan, sweep
from tests.sweeps.files import TEXT, written


def members(path):
    return plan.members(file.read(path), path)


def test_every_method_runs_in_every_setting_with_every_seed(tmp_path):
    found = members(written(tmp_path))
    assert [one.name for one in found] == [
        f"{name}/{seed}"
        for seed in (0, 1)
        for name in ("override/dpt", "strong/dpt", "override/icag-k2", "override/exact", "strong/exact")
    ]
    by_name = {one.name: one for one in found}
    strong = by_name["strong/dpt/1"].run
    assert (strong.method, strong.seed, strong.adversary.p_max, strong.section("darkroom").split_seed) == ("dpt", 1, 0.6, 1)
    assert by_name["override/icag-k2/0"].run.adversary.count == 1 and strong.learner.threads == 1
    assert by_name["override/exact/0"].exact and not by_name["override/dpt/0"].exact
    assert list(by_name["override/dpt/0"].evaluations) == ["online", "unseen"]
    assert list(by_name["strong/dpt/0"].evaluations) == ["online"]


def test_a_method_may_have_seeds_of_its_own(tmp_path):
    path = written(tmp_path, 'method = "dpt"', 'method = "dpt"\nonly = { seeds = [4, 5, 6] }')
    assert [one.seed for one in members(path) if one.variant == "dpt" and one.setting == "strong"] == [4, 5, 6]


def test_a_number_is_the_split_seed_of_all_runs(tmp_path):
    found = members(written(tmp_path, 'split_seed = "seed"', "split_seed = 7"))
    assert {one.run.section("darkroom").split_seed for one in found} == {7}


def test_the_base_run_may_be_a_file_beside_the_sweep_file(tmp_path):
    (tmp_path / "base.toml").write_text('method = "dpt"\n[darkroom]\nsize = 4\nhorizon = 9\n')
    assert members(written(tmp_path, '"smoke"', '"base.toml"'))[0].run.section("darkroom").size == 4


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ('method = "icag"', 'method = "icga"', "[methods.icag-k2]: method = 'icga'; did you mean 'icag'?"),
        ('method = "icag"', 'method = "experts"', "it trains no model"),
        ('method = "icag"', "", "[methods.icag-k2]: has no key method"),
        ("adversary.count = 1", "adversary.cuont = 2", "[methods.icag-k2] in setting override: unknown key adversary.cuont"),
        ("adversary.count = 1", "adversary.count = -1", "[methods.icag-k2] in setting override: adversary.count = -1"),
        ("adversary.count = 1", "adversary = 2", "adversary = 2"),
        ("adversary.p_max = 0.6", "adversary.p_max = 6", "[settings.strong]: adversary.p_max = 6"),
        ('only = { settings = ["override"] }', 'only = { settings = ["overide"] }', "no 'overide'; did you mean 'override'?"),
        ('methods = ["dpt"]', 'methods = ["dtp"]', "[evaluations.unseen] only.methods: no 'dtp'; did you mean 'dpt'?"),
        ("p = [0.4]", "p = [4]", "[evaluations.unseen] for [methods.dpt] in setting override: evaluate.p"),
        ("p = [0.4]", "levels = [0.4]", "[evaluations.unseen]: unknown key levels"),
        ("p = [0.4]", 'suite = "onlin"', "[evaluations.unseen]: suite = 'onlin'"),
        ("p = [0.4]", 'deploy = "committed"', "no action windows"),
        ("seeds = [0, 1]", "seeds = []", "name at least one training seed"),
        ("seeds = [0, 1]", "seeds = [0, 1, 0]", "two runs of one name: override/dpt/0 and override/dpt/0"),
        ("seeds = [0, 1]", "", "seeds"),
        ('run = "smoke"', 'run = ""', "run = '': names no run"),
        ('run = "smoke"', 'run = "smok"', "did you mean 'smoke'?"),
        ('run = "smoke"', 'run = "smoke"\nsplits = 1', "unknown key splits"),
        ("split_seed = ", 'split_seed = "sed" # ', "split_seed = 'sed': use \"seed\""),
        ('method = "dpt"', 'method = "dpt"\nseed = 7', "[methods.dpt]: seed = 7: training seeds are those of seeds"),
        (
            'method = "dpt"',
            'method = "dpt"\ndarkroom.split_seed = 7',
            "[methods.dpt]: darkroom.split_seed: split_seed of the file",
        ),
        ("[settings.strong]", "[settings.strong]\nseed = 3", "[settings.strong]: seed = 3"),
        ("[methods.icag-k2]", '[methods."a/b"]', "use letters, digits and . _ -"),
        ("[evaluations.unseen]", "[evaluations.training]", "[evaluations.training]"),
        ("[settings.override]", "[settings]\noverride = 3", "expected a table"),
        ("[methods.icag-k2]", "[methods.dpt]", "not valid TOML"),
        ("adversary.count = 1", "pretrain.contexts = 140", "environment steps differ"),
        ('method = "dpt"', 'method = "dpt"\nonly = { seeds = [0] }', "training seeds [0] of dpt and [0, 1] of icag-k2 differ"),
        ("[settings.override]", '[equal]\nmethods = ["dpt"]\n[settings.override]', "say in reason why"),
    ],
)
def test_what_cannot_be_is_refused_in_one_line_and_nothing_is_written(tmp_path, old, new, message):
    path = written(tmp_path, old, new)
    with pytest.raises(ConfigError) as refused:
        sweep.make_plan(path, tmp_path / "out")
    text = str(refused.value)
    assert message in text and "\n" not in text and not (tmp_path / "out").exists()
    assert str(path) in text


def test_a_file_that_does_not_exist_and_a_folder_with_other_things_are_refused(tmp_path):
    with pytest.raises(ConfigError, match="No such file"):
        sweep.sweep(tmp_path / "none.toml", tmp_path / "out")
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "mine.txt").write_text("")
    with pytest.raises(ConfigError, match="holds other files and no sweep"):
        sweep.make_plan(written(tmp_path), tmp_path / "out")
    (tmp_path / "out" / "sweep.json").write_text('{"name": "other", "run": "demo"}')
    with pytest.raises(ConfigError, match=r"holds another sweep .the sweep other of run demo\)"):
        sweep.make_plan(written(tmp_path), tmp_path / "out")


@pytest.mark.parametrize(
    ("equal", "refused"),
    [
        ("", True),
        ("labelled_episodes = 0.6\nenvironment_steps = 0.6", False),
        ("labelled_episodes = 0.6\nenvironment_steps = 0.01", True),
        ('methods = ["icag-k2"]\nreason = "it is a trial"', False),
    ],
)
def test_budgets_may_differ_only_as_the_file_says(tmp_path, equal, refused):
    text = TEXT.replace("adversary.count = 1", "pretrain.contexts = 140")
    found = file.read(path := written(tmp_path, text=text, new=f"[equal]\n{equal}\n"))
    lines = list(plan.differences(plan.members(found, path), found))
    assert bool(lines) == refused, lines
    if refused:
        assert "of dpt" in lines[0] and "of icag-k2" in lines[0]


def test_splits_that_differ_are_refused(tmp_path):
    found = file.read(
        path := written(tmp_path, "adversary.count = 1", "darkroom.split_seed = 3", TEXT.replace('split_seed = "seed"', ""))
    )
    assert any(
        "split seeds of override/dpt/0 (0) and override/icag-k2/0 (3) differ" in line
        for line in plan.differences(plan.members(found, path), found)
    )


def test_parts_of_a_sweep_are_chosen_by_name(tmp_path):
    every = members(written(tmp_path))
    assert [one.name for one in plan.chosen(every, ["dpt"], ["strong"], [1])] == ["strong/dpt/1"]
    assert plan.chosen(every) == every
    for wrong in ({"only": ["dtp"]}, {"settings": ["string"]}, {"seeds": [7]}):
        with pytest.raises(ConfigError, match="there are"):
            plan.chosen(every, **wrong)
    with pytest.raises(ConfigError, match="select no run"):
        plan.chosen(every, ["icag-k2"], ["strong"])


def test_the_example_of_the_page_is_a_sweep(tmp_path):
    (example,) = re.findall(r"```toml\n(.*?)```", Path("docs/sweeps.md").read_text(), re.DOTALL)
    made = sweep.make_plan(written(tmp_path, text=example), tmp_path / "out")
    assert len(made.every) == 15 and {one.variant for one in made.every} == {"dpt", "icag-k4", "exact"}


def test_a_folder_whose_sweep_was_killed_before_it_began_is_free(tmp_path):
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / ".lock").touch()
    assert len(sweep.make_plan(written(tmp_path), tmp_path / "out").every) == 10


def test_a_run_that_no_sweep_began_is_refused(tmp_path):
    (tmp_path / "out" / "override" / "dpt" / "0").mkdir(parents=True)
    (tmp_path / "out" / "override" / "dpt" / "0" / "run.toml").touch()
    (tmp_path / "out" / "sweep.json").write_text('{"name": "tiny", "run": "smoke"}')
    with pytest.raises(ConfigError, match="override/dpt/0: holds a run that no sweep began"):
        sweep.make_plan(written(tmp_path), tmp_path / "out")


def test_a_dry_run_lists_runs_and_budgets_and_writes_nothing(tmp_path):
    lines = sweep.describe(sweep.make_plan(written(tmp_path), tmp_path / "out"))
    assert "override/dpt/0  missing  2520 environment steps, 280 labelled episodes, 60 optimizer steps" in lines[0]
    assert "10 runs, 10 of them missing" in lines[-1] and not (tmp_path / "out").exists()


def test_a_dry_run_names_the_steps_of_ardts_return_nets(tmp_path):
    path = written(tmp_path, 'method = "dpt"', 'method = "ardt"\nardt.steps = 70\nadversary.count = 1\nprompt_dt.window = 4')
    path.write_text(path.read_text() + "[equal]\nlabelled_episodes = 1\nenvironment_steps = 1\n")
    (line, *_) = (one for one in sweep.describe(sweep.make_plan(path, tmp_path / "out")) if "/dpt/" in one)
    assert "60 optimizer steps (and 70 of other nets)" in line


def test_rows_that_cannot_be_joined_leave_the_list_of_runs_as_it_was(tmp_path, monkeypatch):
    made = sweep.make_plan(written(tmp_path), tmp_path / "out")
    made.out.mkdir()

    def damaged(files, to):
        raise StoreError("damaged")

    monkeypatch.setattr("icrl_dist.sweeps.rows.join", damaged)
    with pytest.raises(StoreError, match="damaged"):
        sweep._gather(made, None)
    assert not (made.out / "runs.json").exists()
