"""The figures by name."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

from icrl_dist.config.run import ConfigError
from icrl_dist.config.toml import nearest
from icrl_dist.results.figures import budgets, deployment, digests, figure2, figure3, figure6, figure7, strength
from icrl_dist.results.figures.panels import Panel
from icrl_dist.results.figures.reading import Rows
from icrl_dist.results.figures.selection import INFERRED, MissingError, Rules, Study, is_inferred, study
from icrl_dist.results.markup import Sheet

_FIGURES = {"2": figure2, "3": figure3, "6": figure6, "7": figure7, "strength": strength, "deployment": deployment}
_LETTERS = {"3": "abcd", "6": "abcd", "7": "ab"}
TABLES: Mapping[str, Callable[[Study], Sheet]] = {"budgets": budgets.sheet, "digests": digests.sheet}
"""What is a table and no picture."""
WHOLE = (*_FIGURES, *TABLES)
"""The names of whole figures, in the order of a report."""
NAMES = (*(name + letter for name in _FIGURES for letter in ("", *_LETTERS.get(name, ""))), *TABLES)
"""All names of ``--figure``."""


def check(name: str) -> None:
    """Raises ConfigError, with the nearest name, for an unknown figure."""
    if name not in NAMES:
        raise ConfigError(f"--figure {name}: no such figure{nearest(name, NAMES)}; choose one of {', '.join(NAMES)}")


def title(name: str) -> str:
    """The title of a figure."""
    return _FIGURES[_parts(name)[0]].TITLE


def _parts(name: str) -> tuple[str, str]:
    """The figure and the letter of its panel: 3 and b of ``3b``."""
    return (name, "") if name in _FIGURES else (name[:-1], name[-1])


def numbers(name: str, rows: Rows, setting: str | None, rules: Rules) -> list[Panel]:
    """The panels of a figure that is no table.

    ``setting``: None for the only one; of figure ``strength`` for all in which the disturbance must be inferred.  Raises
    ConfigError for an unknown figure, for rows that are missing (with the runs that make them) and for rows that may
    not be compared.
    """
    check(name)
    figure, letter = _parts(name)
    if figure == "strength" and setting is None:
        return _inferred(rows, rules)
    return _FIGURES[figure].numbers(study(rows, setting, rules), letter)


def _inferred(rows: Rows, rules: Rules) -> list[Panel]:
    settings = inferred(rows)
    if not settings:
        raise MissingError("figure strength", [f"{name}/{method}" for name in INFERRED for method in strength.NEEDED])
    return [panel for setting in settings for panel in strength.numbers(study(rows, setting, rules))]


def inferred(rows: Rows) -> Sequence[str]:
    """The settings of the rows in which the disturbance must be inferred."""
    return [name for name in dict.fromkeys(key.setting for key in rows.keys) if is_inferred(name)]
