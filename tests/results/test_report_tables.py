"""The tables of ``icrl-dist report``: budgets and digests of the trainings."""

from __future__ import annotations

import json

import pyarrow.parquet as pq
import pytest

from icrl_dist.config.run import ConfigError
from icrl_dist.results.paper_report import report
from tests.results.synthetic import small, write


def test_the_budgets_of_a_single_variant_are_called_equal_to_nothing(tmp_path):
    path = write(tmp_path, small(tmp_path, agents={"dpt": ("t0",)}), offline=False)
    (section,) = report(path, figure="budgets", out=tmp_path / "report").sections
    assert "A single variant: nothing is compared." in section.sheets[0].caption and "Equal" not in section.sheets[0].caption


@pytest.mark.parametrize("known", [True, False])
def test_the_budgets_name_the_steps_of_ardts_return_nets(tmp_path, known):
    path = write(tmp_path, small(tmp_path, agents={"dpt": ("t0",), "ardt": ("t0",)}), offline=False)
    if known:
        runs = [
            {"setting": "room", "variant": "ardt", "seed": seed, "budget": {"extra_steps": 2500, "optimizer_steps": 300}}
            for seed in range(6)
        ]
        (tmp_path / "runs.json").write_text(json.dumps(runs))
    (section,) = report(path, figure="budgets", out=tmp_path / "report").sections
    number = "2,500" if known else "ardt.steps"
    assert f"the return nets of ardt take {number} smaller steps beside its optimizer steps" in section.sheets[0].caption


def test_small_differences_of_budgets_are_named(tmp_path):
    columns = {"icag": {"environment_steps": 1950}}
    path = write(tmp_path, small(tmp_path, columns=columns), offline=False)
    assert "environment_steps is 1,950 of icag and 2,000 of dpt" in str(report(path, figure="2", out=tmp_path))
    wide = small(tmp_path, columns={"icag": {"environment_steps": 1790}})
    with pytest.raises(ConfigError, match="environment_steps is 1790 of room/icag"):
        report(write(tmp_path / "wide", wide, offline=False), figure="2", out=tmp_path)


@pytest.mark.parametrize("known", [True, False])
def test_every_training_has_a_row_of_digests(tmp_path, known):
    agents = {"icaa": ("t0", "t1"), "dpt": ("t0",), "exact": ("oracle",)}
    path = write(tmp_path, small(tmp_path, agents=agents, seeds=2), offline=False)
    if known:
        runs = [
            {
                "setting": "room",
                "variant": variant,
                "seed": seed,
                "dataset_digest": f"{variant}{seed}".ljust(64, "d"),
                "cpu_seconds": {"collect": 1.2, "fit": 34.6, "evaluate": 5},
            }
            for variant in ("dpt", "icaa")
            for seed in range(2)
        ]
        (tmp_path / "runs.json").write_text(json.dumps(runs))
    (section,) = report(path, figure="digests", out=tmp_path / "report").sections
    (sheet,) = section.sheets
    weights = {  # of the newest model of each training
        (row["variant"], str(row["training_seed"])): row["weights_digest"][:16]
        for row in pq.read_table(path).to_pylist()
        if row["agent"] in ("t1", "t0") and not (row["variant"] == "icaa" and row["agent"] == "t0")
    }
    expected = [
        (
            variant,
            str(seed),
            str(seed),
            f"{variant}{seed}".ljust(64, "d")[:16] if known else "-",
            weights[variant, str(seed)] or "-",
            *(("1", "35", "5") if known else ("-", "-", "-")),
        )
        for variant in ("dpt", "icaa")
        for seed in range(2)
    ]
    assert [tuple(row) for row in sheet.rows] == expected
    text = (tmp_path / "report" / "figure-digests.md").read_text()
    assert all(cell in text for row in expected for cell in row)
