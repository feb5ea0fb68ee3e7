"""How figures are drawn: one colour, dash and marker for each method, which also differ in grey; PNG, CSV and JSON files."""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from icrl_dist.results.figures.panels import Panel, Series, data, is_reference, plain
from icrl_dist.storage.files import atomic_write, write_json

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


class Style(NamedTuple):
    """How the series of one method look."""

    label: str
    color: str
    marker: str
    dash: Any
    hatch: str = ""


STYLES = {
    "dpt": Style("DPT", "#d29922", "s", "-"),
    "prompt_dt": Style("prompt-DT", "#bc4c00", "v", (0, (4, 1.5)), "--"),
    "mix_dpt": Style("mix-DPT", "#8250df", "D", (0, (6, 1.5, 1, 1.5)), "xx"),
    "ardt": Style("ARDT", "#953800", "<", (0, (2, 1)), "++"),
    "ad": Style("AD", "#57606a", ">", (0, (1, 1)), ".."),
    "dr": Style("DR", "#bf3989", "P", (0, (3, 1, 1, 1)), "oo"),
    "icag": Style("ICAG", "#0a3069", "o", "-", ""),
    "icaa": Style("ICAA", "#2da44e", "^", "-", "\\\\"),
    "exact:dpt": Style("exact, DPT's prior", "#8c959f", "", (0, (1, 1.2))),
    "exact:icag": Style("exact, ICAG's prior", "#57606a", "", (0, (5, 1.5))),
    "exact:paper": Style("exact, Algorithm 1", "#57606a", "", (0, (5, 1.5))),
    "oracle": Style("oracle", "#000000", "", "-"),
    "random": Style("random", "#afb8c1", "", "-."),
    "undisturbed": Style("undisturbed experts", "#0a3069", "o", "-"),
    "disturbed": Style("disturbed experts", "#bc4c00", "^", "-"),
}
"""By method, by key of a reference agent, and by kind of variation of SAC experts."""
_OTHER = Style("", "#1f6feb", "x", "-", "||")
_MARKERS = "so*XPDv"
"""Of the second series of one method and of those after it."""


def style_of(name: str) -> Style:
    """The style of a method or a reference agent; ``exact:dpt-committed`` looks as ``exact:dpt``."""
    return STYLES.get(name) or STYLES.get(name.removesuffix("-committed")) or _OTHER._replace(label=name)


def label_of(name: str) -> str:
    """What legends and tables call a method or a reference agent."""
    rule = ", committed" if name.endswith("-committed") and name not in STYLES else ""
    return style_of(name).label + rule if style_of(name).label != name else name


def draw(panels: Sequence[Panel], title: str) -> Figure:
    """The panels side by side, at most two in a row, with one legend below them."""
    from matplotlib.figure import Figure

    columns = min(2, len(panels))
    lines = math.ceil(len(panels) / columns)
    figure = Figure(figsize=(5.4 * columns + 1.2 * (columns == 1), 3.9 * lines + 0.9), layout="constrained")
    axes = figure.subplots(lines, columns, squeeze=False)
    handles: dict[str, Any] = {}
    for axis, panel in zip(axes.flat, panels, strict=False):
        {"lines": _lines, "bars": _bars, "lost": _lost}[panel.kind](axis, panel)
        axis.set_title(f"{panel.name}  {panel.title}" if len(panels) > 1 else panel.title, fontsize=10, loc="left")
        axis.set_xlabel(panel.x_label)
        axis.set_ylabel(panel.y_label)
        axis.grid(alpha=0.25, axis="both" if panel.kind == "lines" else "y")
        axis.set_axisbelow(True)
        handles |= {label: handle for handle, label in zip(*axis.get_legend_handles_labels(), strict=True)}
    for axis in list(axes.flat)[len(panels) :]:
        axis.set_visible(False)
    figure.legend(handles.values(), handles.keys(), fontsize=8, loc="outside lower center", ncols=4, frameon=False)
    figure.suptitle(title, fontsize=11)
    return figure


def _lines(axis: Axes, panel: Panel) -> None:
    for series in panel.series:
        style, x = style_of(series.style), [float(point.x) for point in series.points]
        y = [point.value.value for point in series.points]
        marker = style.marker if series.rank == 0 else _MARKERS[(series.rank - 1) % len(_MARKERS)]
        reference = is_reference(series.style)
        axis.plot(
            x,
            y,
            color=_shade(style.color, series.rank),
            linestyle=style.dash,
            marker=marker or None,
            markevery=max(1, len(x) // 8),
            markersize=4.5,
            linewidth=1.1 if reference else 1.7,
            label=series.name,
            zorder=2 if reference else 3,
        )
        low, high = ([getattr(point.value, side) for point in series.points] for side in ("low", "high"))
        axis.fill_between(x, low, high, color=_shade(style.color, series.rank), alpha=0.06 if reference else 0.12, linewidth=0)


def _shade(color: str, rank: int) -> Any:
    """The colour, lighter for each further series of one method."""
    from matplotlib.colors import to_rgb

    share = 1 - 0.75**rank
    return tuple(part + (1 - part) * share for part in to_rgb(color))


def _error(series: Sequence[Series], index: int) -> list[list[float]]:
    found = [one.points[index].value for one in series]
    return [
        [0.0 if math.isnan(v.low) else v.value - v.low for v in found],
        [0.0 if math.isnan(v.low) else v.high - v.value for v in found],
    ]


def _bars(axis: Axes, panel: Panel) -> None:
    groups = list(dict.fromkeys(str(point.x) for one in panel.series for point in one.points))
    width = 0.84 / max(1, len(panel.series))
    for index, series in enumerate(panel.series):
        style = style_of(series.style)
        for number, point in enumerate(series.points):
            _bar(axis, groups.index(str(point.x)) - 0.42 + (index + 0.5) * width, point, width, style, series, number == 0)
    axis.set_xticks(range(len(groups)), groups)
    axis.set_xlim(-0.6, len(groups) - 0.4)


def _bar(axis: Axes, x: float, point: Any, width: float, style: Style, series: Series, first: bool) -> None:
    value = point.value
    error = None if math.isnan(value.low) else [[value.value - value.low], [value.high - value.value]]
    axis.bar(
        [x],
        [value.value],
        0.9 * width,
        yerr=error,
        capsize=2,
        color=_shade(style.color, series.rank),
        hatch=style.hatch,
        edgecolor="white",
        error_kw={"linewidth": 0.9},
        label=series.name if first else None,
    )


def _lost(axis: Axes, panel: Panel) -> None:
    """A bar to the disturbed return, and on it in white and hatched what was lost; the interval is that of the loss."""
    places = range(len(panel.series))
    after = [one.points[1].value.value for one in panel.series]
    loss = [one.points[2].value.value for one in panel.series]
    axis.bar(places, after, 0.7, color=[style_of(one.style).color for one in panel.series])
    axis.bar(
        places,
        loss,
        0.7,
        bottom=after,
        yerr=_error(panel.series, 2),
        capsize=3,
        color="white",
        edgecolor="black",
        hatch="///",
        linewidth=0.8,
        label="lost, with its 95% interval",
    )
    axis.set_xticks(list(places), [one.name for one in panel.series], rotation=30, ha="right")


def csv_text(panels: Sequence[Panel]) -> str:
    """The numbers of the panels, one line for each point; unknown numbers are empty."""
    out = io.StringIO()
    writer = csv.writer(out, lineterminator="\n")
    writer.writerow(["panel", "series", "x", "value", "low", "high", "certified"])
    for panel in panels:
        for series in panel.series:
            for point in series.points:
                numbers = [plain(number) for number in (*point.value, point.certified)]
                writer.writerow([panel.name, series.name, point.x, *("" if n is None else f"{n:.6g}" for n in numbers)])
    return out.getvalue()


def save(panels: Sequence[Panel], title: str, path: Path) -> list[Path]:
    """Write the figure to ``path``.png and its numbers to ``path``.csv and ``path``.json; returns the paths."""
    found = [path.with_name(f"{path.name}{suffix}") for suffix in (".png", ".csv", ".json")]
    figure = draw(panels, title)
    # Without the version of matplotlib in the file, equal rows give equal bytes after an update too.
    atomic_write(found[0], lambda file: figure.savefig(file, format="png", dpi=130, metadata={"Software": None}))
    atomic_write(found[1], lambda file: file.write(csv_text(panels).encode()))
    write_json(found[2], {"title": title, "panels": [data(panel) for panel in panels]})
    return found
