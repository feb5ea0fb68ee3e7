"""Prints the tables of darkroom.md and README.md that no figure of ``icrl-dist report`` holds: run it without arguments.

Numbers are means over tasks, evaluations and episodes in each training; intervals are Student's t over training seeds.
"""

from pathlib import Path

import pandas as pd
from scipy.stats import t

FOLDER = Path(__file__).parent
COLUMNS = ["suite", "prior", "variant", "agent", "deployment", "training_seed", "p", "episode", "return"]
PLACES = [
    ("overrides, p = 0", "override", 0.0),
    ("p = 0.2", "override", 0.2),
    ("p = 0.4", "override", 0.4),
    ("permuted controls, p = 1", "permuted", 1.0),
    ("wind, p = 0.8", "wind", 0.8),
]
AGENTS = [("DPT", "dpt", "t0"), ("ICAG", "icag", "t0"), ("ICAA, T^3", "icaa", "t3")]
EXACT = [("exact agent, DPT's prior", "exact:dpt"), ("exact agent, ICAG's prior", "exact:icag"), ("oracle", "oracle")]


def means(setting: str, first: int = 15) -> pd.Series:
    """Mean return from episode ``first`` (from 0) on, by p, deployment rule, variant, agent and training seed."""
    rows = pd.read_parquet(FOLDER / setting / "rows.parquet", columns=COLUMNS)
    rows = rows[(rows["suite"] == "online") & (rows["prior"] != "unseen") & (rows["episode"] >= first)]
    return rows.groupby(["p", "deployment", "variant", "agent", "training_seed"])["return"].mean()


def interval(values: pd.Series) -> str:
    """Mean with its 95% interval."""
    half = t.ppf(0.975, len(values) - 1) * values.std(ddof=1) / len(values) ** 0.5
    return f"{values.mean():.1f} [{values.mean() - half:.1f}, {values.mean() + half:.1f}]"


def summary() -> None:
    """Every agent in every setting, as in README.md."""
    by = {setting: means(setting) for _, setting, _ in PLACES}
    print("|", *(f"| {name}" for name, _, _ in PLACES), "|")
    print("|---" * (1 + len(PLACES)) + "|")
    seeds = {place: by[place[1]][place[2], "paper", "icag", "t0"].index for place in PLACES}
    print("| training seeds", *(f"| {len(seeds[place])}" for place in PLACES), "|")
    for name, variant, agent in AGENTS:
        print(f"| {name}", *(f"| {interval(by[setting][p, 'paper', variant, agent])}" for _, setting, p in PLACES), "|")
    for name, agent in EXACT:
        found = (by[place[1]].xs((place[2], "exact", agent), level=[0, 2, 3]).droplevel(0)[seeds[place]] for place in PLACES)
        print(f"| {name}", *(f"| {one.mean():.1f}" for one in found), "|")


def difference(setting: str, one: tuple[str, str, str], two: tuple[str, str, str], first: int = 15) -> None:
    """One agent (deployment rule, variant, agent) less another one, in pairs over training seeds, at each p."""
    found = means(setting, first)
    print(f"{setting}, episodes from {first + 1}: {' '.join(one)} less {' '.join(two)}")
    for p in found.index.unique("p"):
        print(f"  p = {p:g}: {interval((found[p][one] - found[p][two]).dropna())}")


summary()
for first in (0, 15):
    for variant in ("dpt", "icag"):
        difference("committed", ("committed", variant, "t0"), ("paper", variant, "t0"), first)
    difference("committed", ("committed", "icag", "t0"), ("committed", "dpt", "t0"), first)
difference("override", ("paper", "icaa-paper", "t3"), ("paper", "icaa", "t3"))
difference("override", ("paper", "ad", "t0"), ("paper", "dpt", "t0"))
difference("override", ("paper", "dr", "t0"), ("paper", "icag", "t0"))
