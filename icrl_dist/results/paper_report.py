"""``icrl-dist report``: figures, tables and claims of several trainings, from result rows only."""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from icrl_dist.config.paths import path_of
from icrl_dist.config.run import ConfigError
from icrl_dist.config.toml import nearest
from icrl_dist.results import page
from icrl_dist.results.claims import costs, icaa, labels, questions
from icrl_dist.results.claims import sheets as claim_sheets
from icrl_dist.results.figures import catalog, sheets, styles
from icrl_dist.results.figures.panels import data
from icrl_dist.results.figures.reading import BUDGETS, Rows, files_of
from icrl_dist.results.figures.selection import Rules, Study, is_inferred, study
from icrl_dist.results.markup import Sheet
from icrl_dist.storage.files import atomic_write, write_json


@dataclass(frozen=True)
class Section:
    """One part of a report: a text, tables, and the picture of a figure."""

    title: str
    sheets: tuple[Sheet, ...] = ()
    text: str = ""
    picture: Path | None = None
    data: Any = None
    """The numbers as JSON values."""

    def markdown(self) -> str:
        """The section as Markdown; the picture's path is its name, as beside the text."""
        picture = [f"![{self.title}]({self.picture.name})\n"] if self.picture else []
        text = [f"{self.text}\n"] if self.text else []
        return "\n".join([f"## {self.title}\n", *text, *picture, *(sheet.markdown() for sheet in self.sheets)])


@dataclass(frozen=True)
class Report:
    """What a report holds.  ``print`` shows it as Markdown."""

    sections: tuple[Section, ...] = field(repr=False)
    """The parts, in order."""
    refused: tuple[str, ...] = ()
    """Why figures and tables of a whole report are left out, a line each."""
    files: tuple[Path, ...] = ()
    """The files that were written."""

    @property
    def summary(self) -> dict[str, Any]:
        """The report as JSON values: what ``icrl-dist report --json`` prints."""
        parts = [{"title": one.title, "numbers": one.data, "tables": [s.data() for s in one.sheets]} for one in self.sections]
        return {"sections": parts, "refused": list(self.refused), "files": list(map(str, self.files))}

    def markdown(self) -> str:
        """The report as Markdown."""
        left_out = [f"Left out: {line}\n" for line in self.refused]
        return "\n".join([*(section.markdown() for section in self.sections), *left_out])

    def __str__(self) -> str:
        return self.markdown()


def report(
    sources: str | Path | Sequence[str | Path],
    *,
    figure: str | None = None,
    claims: bool = False,
    setting: str | None = None,
    out: str | Path | None = None,
    markdown: str | Path | None = None,
    common_seeds: bool = False,
    unequal_budgets: Sequence[str] = (),
    partial: bool = False,
) -> Report:
    """Figures, tables and the paper's claims, from the result rows of several trainings.

    ``sources``: files of result rows, run folders, or folders of sweeps.  ``figure``: the name of one figure (``"2"``,
    ``"3a"``, ``"strength"``; ``catalog.NAMES`` has all), written to ``out`` as PNG with its numbers as CSV and JSON.
    ``claims``: instead the paper's claims, and the tables of ICAA.  Neither: all figures that the rows allow, with tables
    and claims, as one HTML page, ``out``/index.html.  ``out``: None for the folder ``report`` beside the first source's rows.

    ``setting``: the setting of the sweep; None for the only one (claims, the page and figure ``strength``: also those in
    which the disturbance must be inferred).  ``markdown``: a file for the text of the report.
    ``common_seeds``: compare only training seeds that all compared agents have; ``unequal_budgets``: budgets that may
    differ by more than 10% (``environment_steps``, ``labelled_episodes``, ``optimizer_steps``); ``partial``: show a figure
    without the agents whose rows are missing.  The captions say what was done.

    Raises ConfigError for an unknown figure or setting, for rows that are missing (the message lists the runs that make
    them), and for seeds, splits, evaluation settings or budgets that differ; StoreError for rows of another format,
    and for a file that cannot be written.
    """
    if figure is not None:
        catalog.check(figure)
        if claims:
            raise ConfigError("report: --figure and --claims were given; choose one, or give neither for the whole report")
    files = files_of(sources)
    folder = path_of("out", out) if out is not None else _beside(files[0])
    if folder.exists() and not folder.is_dir():
        raise ConfigError(f"--out {folder}: is a file; name a folder, such as report")
    path = None if markdown is None else path_of("markdown", markdown)
    if path is not None and (path.is_dir() or not path.name):
        raise ConfigError(f"--markdown {str(markdown)!r}: is a folder; name a file, such as report.md")
    rows, rules = Rows(files), Rules(common_seeds, _budgets(unequal_budgets), partial)
    if figure is not None:
        section, written = _figure(rows, setting, rules, figure, folder)
        found = Report((section,), (), tuple(written))
    elif claims:
        refused: list[str] = []
        sections = [part for one in _studies(rows, setting, rules) for part in _tables(one, costs.ledger(files), refused)]
        found = Report(tuple(_joined(sections)), tuple(refused))
    else:
        found = _whole(rows, files, setting, rules, folder)
    if path is not None:
        atomic_write(path, lambda file: file.write(found.markdown().encode()))
        found = Report(found.sections, found.refused, (*found.files, path))
    return found


def _budgets(given: Sequence[str]) -> tuple[str, ...]:
    """Names of budgets.  Raises ConfigError, with the nearest name, for another."""
    names = (given,) if isinstance(given, str) else tuple(given)
    for name in names:
        if name not in BUDGETS:
            raise ConfigError(
                f"--unequal-budgets {name}: no such budget{nearest(name, BUDGETS)}; choose of {', '.join(BUDGETS)}"
            )
    return names


def _beside(file: Path) -> Path:
    """The folder ``report`` of the run or sweep whose rows a file holds."""
    return (file.parent.parent if file.parent.name == "results" else file.parent) / "report"


def _figure(
    rows: Rows, setting: str | None, rules: Rules, name: str, folder: Path, prefix: str = ""
) -> tuple[Section, list[Path]]:
    """One figure and its files, whose names begin with ``prefix``."""
    path = folder / f"{prefix}figure-{name}"
    if name in catalog.TABLES:
        table = catalog.TABLES[name](study(rows, setting, rules))
        written = [path.with_suffix(".md"), path.with_suffix(".json")]
        atomic_write(written[0], lambda file: file.write(table.markdown().encode()))
        write_json(written[1], table.data())
        return Section(table.title, (table,), data=table.data()), written
    panels = catalog.numbers(name, rows, setting, rules)
    title = f"Figure {name}: {catalog.title(name)}" + (f", setting {setting}" if setting else "")
    written = styles.save(panels, title, path)
    tables = tuple(sheets.sheet(panel) for panel in panels)
    return Section(title, tables, picture=written[0], data=[data(panel) for panel in panels]), written


def _studies(rows: Rows, setting: str | None, rules: Rules) -> list[Study]:
    """The study of a setting; None: of the plain one and of those in which the disturbance must be inferred."""
    if setting is not None:
        return [study(rows, setting, rules)]
    first = study(rows, None, rules)
    names = dict.fromkeys([first.setting, *catalog.inferred(rows)])
    return [first if name == first.setting else study(rows, name, rules) for name in names]


def _tables(of: Study, ledger: costs.Ledger, refused: list[str]) -> list[Section]:
    """The claims and the table of ICAA in one setting."""
    found = questions.claims(of, ledger)
    claimed = Section("Claims", (claim_sheets.sheet(found),), claim_sheets.summary(found), data=claim_sheets.data(found))
    sections = [claimed]
    tables: tuple[Callable[[], Sheet], ...] = (
        functools.partial(icaa.sheet, of),
        functools.partial(labels.sheet, of),
        functools.partial(costs.sheet, of, ledger),
    )
    for make in tables:
        try:
            table = make()
        except ConfigError as error:
            refused.append(str(error))
            continue
        sections += [Section(table.title, (table,), data=table.data())] if table.rows else []
    return sections


def _joined(sections: Sequence[Section]) -> list[Section]:
    """The sections with those about claims first."""
    return sorted(sections, key=lambda one: one.title != "Claims")


def _whole(rows: Rows, files: Sequence[Path], setting: str | None, rules: Rules, folder: Path) -> Report:
    """All figures that the rows allow, the tables and the claims, also as one HTML page."""
    settings = list(dict.fromkeys(key.setting for key in rows.keys)) if setting is None else [setting]
    lenient = Rules(rules.common_seeds, rules.unequal_budgets, partial=True)
    figures: list[Section] = []
    tables: list[Section] = []
    written: list[Path] = []
    refused: list[str] = []
    for name in settings:
        of = study(rows, name, rules)
        tables += _tables(of, costs.ledger(files), refused)
        for figure in ("strength", *catalog.TABLES) if is_inferred(name) else (f for f in catalog.WHOLE if f != "strength"):
            try:
                section, made = _figure(rows, name, lenient, figure, folder, f"{name}-" if name else "")
            except ConfigError as error:
                refused.append(str(error))
                continue
            figures.append(section)
            written += made
    if not figures:
        raise ConfigError(f"report: the rows allow no figure; the first: {refused[0]}")
    sections = (*_joined(tables), *figures)
    path = folder / "index.html"
    atomic_write(path, lambda file: file.write(page.html(sections, refused).encode()))
    return Report(sections, tuple(dict.fromkeys(refused)), (path, *written))
