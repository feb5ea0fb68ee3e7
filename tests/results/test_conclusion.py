"""The end of a training: four rows, and a sentence in the words of a comparison."""

import io

import numpy as np
import pytest
from rich.console import Console

from icrl_dist.results import conclusion, tables
from tests.results.row_blocks import block, cells_of, frame, rendered

RNG = np.random.default_rng(0)
NOISE = RNG.normal(size=(6, 4, 8))


def agents(gain, seed=0, newest="t2", p=0.2):
    """Rows of a model with this gain over T^0, of the references, and of what the table leaves out."""
    returns = {newest: 5 + gain, "t0": 5, "random": 1, "exact": 8, "oracle": 9}
    return [block(NOISE + value, agent, p, seed, ceiling=agent == "oracle") for agent, value in returns.items()]


@pytest.mark.parametrize(
    ("gain", "noise", "words"),
    [(2.0, 0.0, "a gain, +2.00"), (-2.0, 0.0, "a loss, -2.00"), (0.1, 3.0, "a gain is not shown, +")],
)
def test_the_table_has_four_rows_and_the_sentence_the_words_of_a_comparison(gain, noise, words):
    rows = agents(gain, p=0.0) + agents(gain)
    rows[5] = block(NOISE + 5 + gain + noise * RNG.normal(size=NOISE.shape), "t2", 0.2)
    found = frame(*rows)
    header, body = cells_of(rendered(conclusion.table(found, "{} held-out tasks".format)))
    assert header == ["agent", "return", "95%", "of oracle"]
    assert [row[0] for row in body] == ["T^2 (dpt)", "T^0", "random", "oracle"] and all(".." in row[2] for row in body)
    text = conclusion.sentence(found)
    assert text.startswith(f"T^2 compared with T^0 at p = 0.2: {words}") and "95% interval" in text
    assert text.endswith("in this training; one training seed says nothing about other seeds")


def test_several_trainings_speak_for_themselves():
    found = frame(*agents(2.0), *agents(2.5, seed=1), *agents(1.5, seed=2))
    assert "a gain, +2.00" in conclusion.sentence(found) and "in this training" not in conclusion.sentence(found)


def test_a_run_without_adapted_versions_is_compared_with_the_random_policy():
    found = frame(block(NOISE + 5, "t0", 0.2), block(NOISE + 1, "random", 0.2))
    _, body = cells_of(rendered(conclusion.table(found, "{} held-out tasks".format)))
    assert [row[0] for row in body] == ["T^0 (dpt)", "random"]
    assert conclusion.sentence(found).startswith("T^0 compared with random at p = 0.2: a gain, +4.00")


def test_a_single_evaluation_has_no_interval_and_shows_nothing():
    found = frame(block([[[1.0]]], "t1", 0.2), block([[[0.0]]], "t0", 0.2))
    _, body = cells_of(rendered(conclusion.table(found, "{} held-out tasks".format)))
    assert [row[2] for row in body] == ["-", "-"]
    assert "a gain is not shown, +1.00, in this training" in conclusion.sentence(found)


def test_the_model_counts_by_its_own_rule():
    rows = [block(NOISE + 5, "t1", 0.2, deployment="committed"), block(NOISE + 3, "t0", 0.2, deployment="committed")]
    found = frame(*rows, block(NOISE, "t1", 0.2, deployment="paper"))
    assert "a gain, +2.00" in conclusion.sentence(found)


@pytest.mark.parametrize("width", [80, 200])
def test_the_table_fits_into_80_columns(width):
    output = io.StringIO()
    Console(file=output, width=width).print(conclusion.table(frame(*agents(1000.0)), "{} held-out tasks".format))
    assert all(len(line.rstrip()) <= 80 for line in output.getvalue().splitlines()[2:]) and "…" not in output.getvalue()


@pytest.mark.parametrize("width", [60, 80, 120, 200])
def test_no_cell_of_a_table_is_cut(width):
    found = frame(
        *(block(np.full((2, 3, 40), 1234.5), agent, 0.2, ceiling=agent == "oracle") for agent in ("t1", "t0", "oracle"))
    )
    for table in (
        tables.returns_table(found, "Return"),
        tables.compare(found, found, names=["the first method", "the second method"]),
    ):
        output = io.StringIO()
        Console(file=output, width=width).print(table)
        lines = output.getvalue().splitlines()
        assert "…" not in output.getvalue() and all(len(line) <= width for line in lines)
    output = io.StringIO()
    Console(file=output, width=width).print(tables.returns_table(found, "Return"))
    (header,) = [line for line in output.getvalue().splitlines() if line.startswith("┃") and "agent" in line]
    assert ("ep 30" in header) == (width >= 120) and "ep 1 " in header and "1234.5" in output.getvalue()
