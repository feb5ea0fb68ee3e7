"""``icrl-dist report``: figures, tables and claims of several trainings."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro
from rich.console import Console

from icrl_dist.cli.exit_codes import OK


@dataclass(frozen=True)
class ReportArguments:
    """Make the paper's figures, tables and claims from result rows of several trainings.

    Without ``--figure`` and ``--claims`` it makes all figures that the rows allow, with tables and claims, as one
    HTML page: ``icrl-dist report runs/sweep``.  It refuses, in one line, to compare trainings whose seeds, splits,
    evaluations or budgets differ, and lists the runs that make missing rows.
    """

    sources: Annotated[tyro.conf.Positional[tuple[Path, ...]], tyro.conf.arg(metavar="ROWS_OR_RUN_DIR ...")]
    """Files of result rows (``rows.parquet`` of a sweep), folders of sweeps, or run folders."""
    figure: str | None = None
    """One figure.  ``2``: return lost under p = 0.2.  ``3``: all methods offline (``3a``), online (``3b``), against p
    (``3c``), with unseen priors (``3d``).  ``6``: the same for ICAG with K = 4, 8, 16.  ``7``: ICAA after each round
    beside ICAG (``7a``, ``7b``).  ``strength``: return against p in the settings wind and permuted.
    ``deployment``: each method by each of its rules.  ``budgets``: the table of equal budgets.  ``digests``: the table of
    all trainings with their digests."""
    claims: bool = False
    """Print the paper's claims one by one, with effect sizes, intervals over training seeds and verdicts, and the table of
    ICAA's rounds."""
    setting: str | None = None
    """A setting of the sweep.  Default: the only one; with claims and the page also wind and permuted."""
    out: Path | None = None
    """Folder for figures (PNG, with their numbers as CSV and JSON) and the page.  Default: report/ beside the rows."""
    markdown: Path | None = None
    """Also write the text of the report to this file, as Markdown."""
    common_seeds: bool = False
    """Compare only the training seeds that all compared agents have.  Default: different seeds are refused."""
    unequal_budgets: tuple[str, ...] = ()
    """Budgets that may differ between compared methods by more than 10%: ``environment_steps``,
    ``labelled_episodes``, ``optimizer_steps``.  Default: they are refused; smaller differences are named in captions."""
    partial: bool = False
    """Show a figure without the agents whose rows are missing.  Default: missing rows are refused, with the runs
    that make them."""
    json: bool = False
    """Print one JSON object on the last line."""


def report(arguments: ReportArguments, console: Console) -> int:
    """Make the report and print its tables.  Returns the exit code."""
    from icrl_dist.results import paper_report

    options = ("figure", "claims", "setting", "out", "markdown", "common_seeds", "unequal_budgets", "partial")
    chosen = {name: getattr(arguments, name) for name in options}
    found = paper_report.report(list(arguments.sources), **chosen)
    console.print(str(found), highlight=False, markup=False)
    for path in found.files:
        console.print(f"wrote {path}", highlight=False, markup=False)
    if arguments.json:
        print(json.dumps(found.summary))
    return OK
