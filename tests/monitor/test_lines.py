"""Columns, cells, durations and filters of the terminal view."""

import pytest

from icrl_dist.monitor.lines import Column, cell, fit
from icrl_dist.monitor.view_state import duration, matches


@pytest.mark.parametrize(
    ("query", "expected"),
    [
        ("", True),
        ("task 3", True),
        ("task 31", False),
        ("task 3/1", True),
        ("task 3/2", False),
        ("NULL 3/1", True),
        ("task null", True),
        ("task", False),
        ("null dirichlet", False),
        ("null task 3", True),
    ],
)
def test_rows_that_match_a_filter(query, expected):
    assert matches({"task": 3, "variation": 1, "search_text": "3/1 adapt/0 null goal 2,2"}, query) == expected


def test_columns_are_removed_by_rank_and_the_rest_is_stretched():
    columns = [Column("a", "", 4), Column("b", "", 6, rank=2, stretch=1), Column("c", "", 5, rank=1)]
    assert [(c.name, w) for c, w in fit(columns, 30)] == [("a", 4), ("b", 18), ("c", 5)]
    assert [(c.name, w) for c, w in fit(columns, 12)] == [("a", 4), ("c", 5)]
    assert [(c.name, w) for c, w in fit(columns, 1)] == [("a", 4)]


@pytest.mark.parametrize(
    ("given", "width", "expected"), [("abc", 5, "abc  "), ("abcdef", 4, "abc…"), ("名前x", 4, "名 …"), ("", 2, "  ")]
)
def test_a_cell_has_exactly_its_width(given, width, expected):
    assert cell(given, width) == expected


@pytest.mark.parametrize(("seconds", "expected"), [(None, "-"), (7.9, "0:07"), (201, "3:21"), (3723, "1:02:03")])
def test_durations(seconds, expected):
    assert duration(seconds) == expected
