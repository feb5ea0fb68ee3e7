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


def shares(episodes: int = 10) -> None:
    """Return of the first episodes as a share of the oracle's, by both deployment rules."""
    rows = pd.read_parquet(FOLDER / "committed" / "rows.parquet", columns=COLUMNS)
    rows = rows[rows["episode"] < episodes]
    found = rows.groupby(["variant", "agent", "deployment", "p", "training_seed"])["return"].mean()
    oracle = found["exact", "oracle"].groupby(level=[1, 2]).mean()
    print(f"share of the oracle's return, first {episodes} episodes")
    for variant, agent in (("dpt", "t0"), ("icag", "t0"), *(("exact", one) for one in ("exact:icag", "exact:icag-committed"))):
        for rule, values in found[variant, agent].groupby(level=0):
            share = (values.droplevel(0) / oracle).groupby(level=0)
            texts = (f"p = {p:g}: {interval(100 * one)}%;" for p, one in share)
            print(f"  {variant} {agent} {rule}:", *texts)


def never_found(agent: str, variant: str, rule: str) -> None:
    """Share of the evaluations at p = 0 with return 0 in all episodes; what the others lose to the exact agent at the end."""
    columns = [*COLUMNS, "task_index", "evaluation_seed"]
    rows = pd.read_parquet(FOLDER / "override" / "rows.parquet", columns=columns)
    rows = rows[(rows["suite"] == "online") & (rows["p"] == 0)]
    place = ["training_seed", "task_index", "evaluation_seed"]
    one = rows[(rows["variant"] == variant) & (rows["agent"] == agent) & (rows["deployment"] == rule)]
    exact = rows[(rows["variant"] == "exact") & (rows["agent"] == "exact:dpt")]
    lost = one.groupby(place)["return"].max() == 0
    ends = (of[of["episode"] >= 15].groupby(place)["return"].mean() for of in (exact, one))
    less = next(ends) - next(ends)
    found = less.reindex(lost.index)[~lost]
    print(f"{variant} {agent} {rule}: return 0 throughout {lost.mean():.1%} of {len(lost)}; the others lose {found.mean():.2f}")


summary()
shares()
for variant, agent, rule in (("dpt", "t0", "paper"), ("icag", "t0", "paper"), ("icaa", "t3", "paper"), ("ad", "t0", "paper")):
    never_found(agent, variant, rule)
for first in (0, 15):
    for variant in ("dpt", "icag"):
        difference("committed", ("committed", variant, "t0"), ("paper", variant, "t0"), first)
    difference("committed", ("committed", "icag", "t0"), ("committed", "dpt", "t0"), first)
difference("override", ("paper", "icaa-paper", "t3"), ("paper", "icaa", "t3"))
difference("override", ("paper", "ad", "t0"), ("paper", "dpt", "t0"))
difference("override", ("paper", "dr", "t0"), ("paper", "icag", "t0"))
difference("committed", ("paper", "icag", "t0"), ("paper", "dpt", "t0"))
