"""A panel's numbers as a table: one row for each series."""

from __future__ import annotations

from icrl_dist.results.figures.panels import Panel, Series
from icrl_dist.results.markup import CERTIFIED, Sheet, interval, number

_COLUMNS = 8
"""Values of a curve that a table shows."""


def sheet(panel: Panel) -> Sheet:
    """The panel's numbers, of a long curve some; the last column is the certified return at the last of them."""
    x = [point.x for point in panel.series[0].points]
    if len(x) > _COLUMNS:
        x = [value for value in x if value in (1, 2, 5, 10, 20, 30, x[-1])]
    at = x[-2] if panel.kind == "lost" else x[-1]
    names = [f"ep {value}" if panel.x_label == "online episode" else _named(panel, value) for value in x]
    columns = ("agent", *names, f"certified, {names[x.index(at)]}")
    rows = tuple(_row(series, x, at) for series in panel.series)
    return Sheet(f"{panel.name}: {panel.title}", columns, rows, f"{panel.caption}. {CERTIFIED}")


def _named(panel: Panel, value: float | str) -> str:
    return value if isinstance(value, str) else f"{panel.x_label} = {value:g}"


def _row(series: Series, x: list[float | str], at: float | str) -> tuple[str, ...]:
    by = {point.x: point for point in series.points}
    return (series.name, *(interval(by[value].value, "{:.2f}") for value in x), number(by[at].certified))
