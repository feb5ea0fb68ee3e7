"""What ``icrl-dist report`` says of ICAA's own labels and of what a label costs, against slow loops."""

from __future__ import annotations

import json

import numpy as np
import pytest

from icrl_dist.results import rows
from icrl_dist.results.claims import costs, labels
from icrl_dist.results.figures.reading import Rows
from icrl_dist.results.figures.selection import MissingError, Rules, study
from icrl_dist.results.paper_report import report
from icrl_dist.storage.files import StoreError
from tests.results.row_blocks import block
from tests.results.synthetic import Sweep, plain, write

AGENTS = {"dpt": ("t0",), "icag": ("t0",), "icaa": ("t0", "t1")}
CONTEXTS, TRIALS, TASKS, SEEDS = 2, 6, 5, 6


def small(columns=None):
    return Sweep(plain, AGENTS, "room", SEEDS, goals=2, evaluations=1, episodes=2, columns=columns or {}, levels=(0.0, 0.2))


def rated(folder, **others):
    """Rows of suite ``label_quality`` of two rounds, with their returns and agreements by seed and round."""
    rng, found, blocks = np.random.default_rng(0), {}, []
    for seed in range(SEEDS):
        for version in range(2):
            returns, agreement = rng.normal(30, 3, (TASKS, 1, TRIALS)), rng.uniform(0.5, 1, TASKS)
            returns[..., CONTEXTS:] += 4 + version
            agreement[0] = np.nan  # the first variation gave no label
            found[seed, version] = returns, agreement
            data = np.where(np.arange(TRIALS) < CONTEXTS, "context", "labels")
            named = {"setting": "room", "variant": "icaa", "method": "icaa", "prior": "", "tasks": "train"}
            named |= {"data": np.tile(data, TASKS).astype(object), "agreement": np.repeat(agreement, TRIALS)} | others
            blocks.append(block(returns, f"t{version}", None, seed, optimum=np.full(TASKS, 50.0), **named))
    return rows.append(folder, "label_quality", {}, blocks), found


def test_the_labels_of_each_round_are_means_over_seeds_with_the_gain_in_pairs(tmp_path):
    file, numbers = rated(tmp_path / "labels")
    path = write(tmp_path, small(), offline=False)
    sheet = labels.sheet(study(Rows([path, file]), "room", Rules()))
    assert [row[:3] for row in sheet.rows] == [("0", "T^0", "0 to 5"), ("1", "T^1", "0 to 5")]
    for version, row in enumerate(sheet.rows):
        cells = dict(zip(sheet.columns, row, strict=True))
        agreement, gains, early = [], [], []
        for seed in range(SEEDS):
            returns, agreed = numbers[seed, version]
            agreement.append(np.mean([one for one in agreed if one == one]))
            early.append(np.mean([returns[t, 0, n] for t in range(TASKS) for n in range(CONTEXTS)]))
            later = np.mean([returns[t, 0, n] for t in range(TASKS) for n in range(CONTEXTS, TRIALS)])
            gains.append(later - early[-1])
        assert cells["agreement"].startswith(f"{np.mean(agreement):.1%} [") and cells["labelling"].startswith("80.0% [")
        assert cells["return, contexts"].startswith(f"{np.mean(early):.2f} [")
        gain = cells["gain"]
        assert gain.startswith(f"{np.mean(gains):+.2f} [")
        low, high = (float(part) for part in gain.partition("[")[2].rstrip("]").split(", "))
        half = 2.5706 * np.std(gains, ddof=1) / np.sqrt(SEEDS)  # Student's t with 5 degrees of freedom
        assert (low, high) == pytest.approx((np.mean(gains) - half, np.mean(gains) + half), abs=0.15 * half)
    assert "95% intervals over training seeds" in sheet.caption


def test_rows_of_older_versions_have_no_returns_of_contexts_and_missing_ones_are_named(tmp_path):
    path = write(tmp_path, small(), offline=False)
    with pytest.raises(MissingError, match="table of ICAA's labels: rows are missing; these runs make them: room/icaa, seeds"):
        labels.sheet(study(Rows([path]), "room", Rules()))
    file, _ = rated(tmp_path / "labels", data="")
    for row in labels.sheet(study(Rows([path, file]), "room", Rules())).rows:
        assert row[3] != "-" and row[-3:] == ("-", "-", "-")


def runs(folder, **others):
    """``runs.json`` of the small sweep: ICAG has 1000 labels of a training, and ICAA 500."""
    found = [
        {
            "setting": "room",
            "variant": variant,
            "seed": seed,
            "cpu_seconds": {"fit": cpu, "collect": seed % 2, "evaluate": 99},
            "labels": number,
            "label_bytes": 28 * number,
            "sent_bytes": 60_000,
            **others,
        }
        for variant, cpu, number in (("icag", 10.0, 1000), ("icaa", 20.0, 500))
        for seed in range(SEEDS)
    ]
    (folder / "runs.json").write_text(json.dumps(found))


def test_costs_are_those_of_a_label_and_are_paired(tmp_path):
    """Budgets are equal by design, so that totals decide nothing: all environment steps here are 2000."""
    path = write(tmp_path, small(), offline=False)
    runs(tmp_path)
    of, ledger = study(Rows([path]), None, Rules()), costs.ledger([path])
    found = list(costs.findings(of, ledger))
    assert [one.effect.value for one in found] == pytest.approx([2 - 4, 10.5 - 41, 0, 60 - 120])
    assert [one.verdict for one in found] == ["not held", "not held", "not shown", "not held"]
    rows_of = {row[0]: dict(zip(costs.sheet(of, ledger).columns, row, strict=True)) for row in costs.sheet(of, ledger).rows}
    assert rows_of["icag"]["labels"] == "1,000" and rows_of["icaa"]["environment steps per label"] == "4"
    assert rows_of["icaa"]["CPU-seconds of training per 1000 labels"] == "41"
    text = str(report(path, claims=True))
    assert "**Costs of ICAG and ICAA, setting room**" in text and "computed from the run file" in text
    assert {one.verdict for one in costs.findings(of, {})} == {"not decidable"}
    runs(tmp_path, labels=None)
    assert {one.verdict for one in costs.findings(of, costs.ledger([path]))} == {"not decidable"}
    (tmp_path / "runs.json").write_text("[1]")
    with pytest.raises(StoreError, match=r"runs.json: no list of a sweep's runs"):
        costs.ledger([path])
