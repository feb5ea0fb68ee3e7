"""Numbers from result rows: what ``result.json``, tables and figures show.  Pure functions of the rows."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Float64

from icrl_dist.interfaces import LabelQuality
from icrl_dist.results import statistics
from icrl_dist.results.names import AgentKey
from icrl_dist.results.returns import LAST, Returns, check_pairs, returns
from icrl_dist.results.statistics import Interval
from icrl_dist.telemetry.metrics import HeldOut

if TYPE_CHECKING:
    import pandas as pd


@dataclass(frozen=True, eq=False)
class Ceiling:
    """What returns are shown as a share of: a reference that is given the task, or the exact optimum."""

    name: str
    scores: Float64[np.ndarray, "S C E"]


def ceilings(found: list[Returns], last: int = LAST) -> dict[tuple[float, AgentKey], Ceiling]:
    """By p and agent: the first agent that is given the task (such as the oracle), or else the agent's exact optimum."""
    agents = [one for one in found if one.ceiling]
    if agents:
        best = {one.p: Ceiling(one.name, one.scores(last)) for one in agents if one.agent == agents[0].agent}
        return {(one.p, one.agent): best[one.p] for one in found if one.p in best}
    return {(one.p, one.agent): Ceiling("oracle", one.optimum) for one in found if one.optimum is not None}


def intervals(found: list[Returns], last: int = LAST) -> dict[tuple[float, AgentKey], tuple[Interval, Interval | None]]:
    """By p and agent: the mean return over the last episodes, and its share of the ceiling (None without one).

    The intervals are those of ``statistics.estimate``, with the same resamples for all agents at one p.  Raises
    ConfigError for agents whose rows have no partner (``check_pairs``).
    """
    best, answer = ceilings(found, last), {}
    for p in dict.fromkeys(one.p for one in found):
        here = [one for one in found if one.p == p]
        for one in here[1:]:
            check_pairs(here[0], one)
        scores = [one.scores(last) for one in here]
        tops = [best[p, one.agent].scores if (p, one.agent) in best else np.full_like(scores[0], np.nan) for one in here]
        both = statistics.estimate(np.stack(scores + tops), _means_and_shares, here[0].crossed)
        for one, value, share in zip(here, both, both[len(here) :], strict=False):
            answer[p, one.agent] = value, share if (p, one.agent) in best else None
    return answer


def _means_and_shares(scores: Float64[np.ndarray, "R A S C"]) -> Float64[np.ndarray, "R A"]:
    """From scores of agents and, after them, of what each is a share of: the means, then the shares."""
    means, tops = np.split(statistics.mean(scores), 2, axis=-1)
    return np.concatenate([means, statistics.quotient(means, tops)], axis=-1)


def result_rows(frame: pd.DataFrame) -> list[dict[str, Any]]:
    """The rows of ``result.json``: one per p and agent, as JSON values."""
    found = returns(frame)
    estimates = intervals(found)
    return [_result_row(one, estimates[one.p, one.agent][0]) for one in found]


def _result_row(one: Returns, last: Interval) -> dict[str, Any]:
    mean, error = one.by_episode()
    best = None if one.optimum is None else float(one.optimum.mean())
    return {
        "agent": one.name,
        "key": one.agent.agent,
        "deployment": one.agent.deployment,
        "data": one.agent.data,
        "p": one.p,
        "episodes": [round(float(m), 3) for m in mean],
        "standard_error": [_rounded(float(e), 3) for e in error],
        "optimum": None if best is None else round(best, 3),
        "last5": round(last.value, 3),
        "last5_interval": [_rounded(last.low, 3), _rounded(last.high, 3)],
        "last5_over_optimum": None if best is None else _share(last.value, best),
        **({} if (worst := one.certificate()) is None else {"certified": round(worst, 3)}),
        **({"broken": one.diverged} if one.diverged else {}),
    }


def adaptation(frame: pd.DataFrame) -> dict[str, dict[str, float | int | None]]:
    """How fast the first agent of the rows adapts, by p, relative to the oracle; empty if no optimum is known.

    ``first10_over_oracle``: mean return over the first 10 episodes (or all, if there are fewer), as a share of the
    oracle's in these episodes.  ``episode_of_90``: first episode, from 1, whose mean return is at least 90% of the
    oracle's mean over all episodes; None if there is none.
    """
    found = returns(frame)
    oracle = {one.p: one for one in found if one.ceiling and one.optimum is not None}
    if not oracle:
        return {}
    newest = [one for one in found if one.agent == found[0].agent]
    return {
        "first10_over_oracle": {f"{one.p:g}": first_over(one, oracle[one.p], 10) for one in newest},
        "episode_of_90": {f"{one.p:g}": episode_of(one, oracle[one.p], 0.9) for one in newest},
    }


def first_over(one: Returns, oracle: Returns, episodes: int) -> float | None:
    """Mean return over the first episodes, as a share of the oracle's in these episodes; None if that is not above 0."""
    return _share(float(one.flat[:, :, :episodes].mean()), float(oracle.flat[:, :, :episodes].mean()))


def _share(value: float, whole: float) -> float | None:
    return _rounded(float(statistics.quotient(np.array(value), np.array(whole))), 4)


def _rounded(value: float, digits: int) -> float | None:
    """A JSON value: None for nan."""
    return None if np.isnan(value) else round(value, digits)


def episode_of(one: Returns, oracle: Returns, share: float) -> int | None:
    """First episode, from 1, whose mean return is at least this share of the oracle's mean over all episodes.

    None if there is none, or if the oracle's mean is not above 0.
    """
    best = oracle.flat.mean()
    good = (one.flat.mean(axis=(0, 1)) >= share * best) & (best > 0)
    return int(good.argmax()) + 1 if good.any() else None


def heldout_metrics(rows: Sequence[Mapping[str, Any]]) -> list[HeldOut]:
    """The rows of ``result_rows`` as metrics.

    The model has one curve over policy versions for each rule that deploys it.
    """
    versions = [int(row["key"][1:]) for row in rows if AgentKey(row["key"]).is_model]
    newest = max(versions, default=0)
    rules = {row["deployment"] for row in rows if AgentKey(row["key"]).is_model}
    answer = []
    for row in rows:
        is_model, (low, high) = AgentKey(row["key"]).is_model, row["last5_interval"]
        name = "model" + (f"-{row['deployment']}" if len(rules) > 1 else "") if is_model else row["key"]
        values = {"return": row["last5"], "low": low, "high": high}
        kept = {key: value for key, value in values.items() if value is not None}
        answer.append(HeldOut(row["p"], name, int(row["key"][1:]) if is_model else newest, kept))
    return answer


def surprise(frame: pd.DataFrame) -> dict[str, dict[str, float]]:
    """Median of the OOD score after the last episode, and the share of scores above 1, by p; empty if it was not measured."""
    scored = frame[frame["surprise"].notna()]
    return {
        f"{p:g}": {
            "median": round(float(np.median(rows["surprise"])), 2),
            "above_1": round(float((rows["surprise"] > 1).mean()), 4),
        }
        for p, rows in scored.groupby("p", sort=False)
    }


def experts(frame: pd.DataFrame) -> list[dict[str, Any]]:
    """Returns of the first and the last recorded episode of each expert, from the rows of suite ``experts``, by variation."""
    answer = []
    for _, rows in frame.groupby(["task_index", "adversary_index"]):
        ends = rows.sort_values("episode")["return"].iloc[[0, -1]]
        task = {name: round(value, 4) for name, value in json.loads(rows["task"].iloc[0]).items() if isinstance(value, float)}
        adversary = str(rows["adversary_family"].iloc[0])
        answer.append({"task": task, "adversary": adversary, "returns": [round(float(value), 2) for value in ends]})
    return answer


def label_quality(frame: pd.DataFrame) -> LabelQuality:
    """Quality of the labels that T^j made in a round, from the rows of suite ``label_quality`` (Theorem E.5).

    Returns are nan for rows of older versions, whose column ``data`` does not say which trials became contexts.
    """
    early, late = frame["data"] == "context", frame["data"] == "labels"
    by = ["task_index", "adversary_index"]
    variations = frame.groupby(by)[["agreement", "optimum"]].first()
    rated = variations["agreement"].dropna()
    return LabelQuality(
        agreement=float(rated.mean()) if len(rated) else 0.0,
        labelling=len(rated) / len(variations),
        context_return=float(frame[early].groupby(by)["return"].mean().mean()),
        label_return=float(frame[late].groupby(by)["return"].mean().mean()),
        optimum=float(variations["optimum"].mean()),
    )
