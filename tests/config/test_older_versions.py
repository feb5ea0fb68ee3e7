"""What version 0.1.0 wrote is read with its former names and values; a user's file with them is refused.

The files in ``written_by_0_1_0`` were written by the last revision before the names changed: ``run.toml``, ``fork.json``
and the manifest of T^1 of a small run, and ``run.toml`` of a continuous problem.
"""

from __future__ import annotations

import dataclasses
import json
import tomllib
from pathlib import Path

import pytest

from icrl_dist.agent import shipped as agent_files
from icrl_dist.config import former_names
from icrl_dist.config.run import ConfigError, Run, dumps, load, load_folder, parse, parse_written
from icrl_dist.config.sections import AdversaryConfig
from icrl_dist.problems import registry
from icrl_dist.problems.continuous import calibrated_strength
from icrl_dist.storage.checkpoint import load_checkpoint
from icrl_dist.storage.fork import Lineage
from icrl_dist.types import NULL

OLD = Path(__file__).parent / "written_by_0_1_0"
ICAG, CARTPOLE = ((OLD / f"{name}.toml").read_text() for name in ("icag", "cartpole"))


def run_folder(folder: Path, text: str = ICAG) -> Path:
    folder.mkdir()
    (folder / "run.toml").write_text(text)
    (folder / "env.json").write_text("{}")
    return folder


def check_icag(run: Run) -> None:
    """The run has the numbers of icag.toml, under present names."""
    dagger, pretrain = run.dagger, run.pretrain
    assert (dagger.rounds, dagger.trials, dagger.steps, dagger.new_fraction) == (1, 3, 10, 0.5)
    assert (pretrain.windows, pretrain.decoy_fraction, pretrain.behaviors) == (2, 0.25, ("random", "goals"))
    assert (run.model.window, run.optim.windows, run.section("darkroom").size) == (3, 2, 3)
    assert not hasattr(run, "control") and parse(dumps(run), "again") == run


def test_the_settings_of_an_old_run_folder_are_read(tmp_path: Path) -> None:
    folder = run_folder(tmp_path / "old")
    check_icag(load_folder(folder))
    assert load(str(folder / "run.toml")) == load_folder(folder), "a user may name the file of a run folder"


def test_dagger_rounds_that_icaa_ignored_are_left_out() -> None:
    """An older version allowed them; a user's file with them is refused."""
    old = ICAG
    for before, after in (('"icag"', '"icaa"'), ("stretches = 2", "stretches = 0"), ("stretch = 3", "stretch = 1")):
        old = old.replace(before, after)
    assert parse_written(old, "x").dagger.rounds == 0 and parse_written(old, "x").dagger.trials == 3
    now = dumps(parse_written(old, "x")).replace("[dagger]\nrounds = 0", "[dagger]\nrounds = 1")
    with pytest.raises(ConfigError, match=r"dagger.rounds = 1: icaa has no such rounds"):
        parse(now, "x")
    assert parse_written(now, "x").dagger.rounds == 0


def test_each_former_name_is_in_the_old_file_and_keeps_its_value() -> None:
    before, after = tomllib.loads(ICAG), tomllib.loads(dumps(parse_written(ICAG, "x")))
    for old, new in former_names.RENAMED.items():
        (section, _, key), (present, _, name) = old.partition("."), new.partition(".")
        assert (before[section][key] if key else before[section]) == (after[present][name] if name else after[present])


@pytest.mark.parametrize("name", ["mine.toml", "run.toml"])
def test_a_file_of_a_user_is_refused_with_the_new_name(tmp_path: Path, name: str) -> None:
    file = tmp_path / name
    file.write_text(ICAG)
    with pytest.raises(ConfigError, match=r"practice is now called dagger: rename it"):
        load(str(file))


def test_mistakes_in_a_written_file_are_still_refused(tmp_path: Path) -> None:
    for text, part in (
        ("[darkroom]\nsiz = 3", "unknown key darkroom.siz"),
        ("practice = 3", "expected a table"),
        ("[", "TOML"),
    ):
        with pytest.raises(ConfigError, match=part):
            parse_written(text, "x")
    with pytest.raises(ConfigError, match=r"run\.toml'?: no such file"):
        load_folder(tmp_path)


def test_a_continuous_run_keeps_its_split_and_its_strength() -> None:
    """Its split had the seed of Dark Room's section, and ``drop`` was called ``bite``."""
    run = parse_written(CARTPOLE, "x")
    control = run.section("control")
    assert (control.split_seed, control.strength) == (7, "drop:0.25") and not hasattr(run, "darkroom")
    assert control.solved == "dmc-cartpole-balance/paper/drop:0.25=3968.0"
    tested = [(task["cart_mass"], task["pole_mass"]) for task in registry.of(run).split.test]
    assert tested == [(0.642857143, 1.0), (0.928571429, 3.714285714), (0.785714286, 9.142857143), (0.5, 11.857142857)]
    other = parse_written(CARTPOLE.replace("3968.0", "3000.0"), "x").section("control")
    assert calibrated_strength.strength(other, run.problem) == 3000.0, "the number that was solved then, not today's table"
    assert parse_written(dumps(run), "again") == run


def test_a_present_split_seed_has_precedence() -> None:
    text = CARTPOLE.replace("[control]", "[control]\nsplit_seed = 3")
    assert parse_written(text, "x").section("control").split_seed == 3


def test_the_ancestors_of_an_old_fork_are_read(tmp_path: Path) -> None:
    folder = run_folder(tmp_path / "fork", ICAG.replace("steps = 10", "steps = 12"))
    (folder / "fork.json").write_text((OLD / "fork.json").read_text())
    own = load_folder(folder)
    lineage = Lineage.of(folder, own)
    check_icag(lineage.run_of(0))
    assert lineage.run_of(1) is own and own.dagger.steps == 12
    assert dataclasses.replace(own, dagger=lineage.run_of(0).dagger) == lineage.run_of(0)


def test_the_settings_in_an_old_manifest_are_read() -> None:
    check_icag(parse_written(json.loads((OLD / "manifest.json").read_text())["run"], "x"))


def test_phi_0_was_one_of_the_counted_adversaries() -> None:
    """A file without ``adversary.null`` means one disturbance less; one with it, and a user's, means what it says."""
    for text, count, null in (
        ("count = 2\np_max = 0.2", 1, True),
        ("count = 1", 0, True),
        ("count = 2\nnull = true", 2, True),
        ("count = 2\nnull = false", 2, False),
    ):
        adversary = parse_written(f"[adversary]\n{text}", "x").adversary
        assert (adversary.count, adversary.null) == (count, null)
    assert parse_written(ICAG, "x").adversary == AdversaryConfig(count=1, p_max=0.2)
    assert parse("[adversary]\ncount = 2", "x").adversary.count == 2
    run = parse_written(ICAG, "x")
    variations = registry.training_variations(run, 0, registry.of(run).split.train[0])
    assert len(variations) == tomllib.loads(ICAG)["adversary"]["count"] and variations[0].adversary == NULL
    shipped = load_checkpoint(Path(agent_files.__path__[0]) / "darkroom.npz").manifest["run"]
    former = tomllib.loads(shipped)["adversary"]["count"]
    assert parse_written(shipped, "x").adversary == AdversaryConfig(count=former - 1, null=True)
    for wrong in ('count = "two"', "count = 0", "count = true"):
        with pytest.raises(ConfigError, match=r"adversary\.count"):
            parse_written(f"[adversary]\n{wrong}", "x")
