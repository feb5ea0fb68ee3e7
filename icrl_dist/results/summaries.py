"""Numbers from result rows: what ``result.json``, tables and figures show.  Pure functions of the rows."""

from __future__ import annotations

import json
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Float, Float64

from icrl_dist.config.random_keys import RandomKey, generator
from icrl_dist.config.run import ConfigError
from icrl_dist.interfaces import LabelQuality
from icrl_dist.results import statistics
from icrl_dist.results.names import AgentKey, names

if TYPE_CHECKING:
    import pandas as pd

LAST = 5
"""Episodes at the end of an evaluation whose mean return is shown."""
_INDEX = ["training_seed", "task_index", "evaluation_seed", "episode"]


@dataclass(frozen=True, eq=False)
class Returns:
    """The rows of one agent at one p as arrays: S trainings, C tasks, E evaluations of each, N episodes an evaluation."""

    agent: AgentKey
    name: str
    """What tables call the agent."""
    p: float
    returns: Float64[np.ndarray, "S C E N"]
    optimum: Float64[np.ndarray, "S C"] | None
    """Expected return of the optimal policy; None if it is not known."""
    ceiling: bool
    """The agent is given the task, so other returns are also shown as a share of its returns."""
    diverged: int
    """Episodes in which the simulation diverged."""
    training_seeds: tuple[int, ...]
    cells: tuple[tuple[tuple[object, ...], ...], ...]
    """By training and task: split seed, task parameters, adversary's family and parameters."""
    evaluation_seeds: tuple[int, ...]

    @property
    def crossed(self) -> bool:
        """Whether all trainings were evaluated on the same tasks."""
        tasks = [[cell[:2] for cell in training] for training in self.cells]
        return all(training == tasks[0] for training in tasks)

    def last(self, episodes: int = LAST) -> float:
        """Mean return over the last episodes."""
        return float(self.flat[:, :, -episodes:].mean())

    def scores(self, episodes: int = LAST) -> Float64[np.ndarray, "S C E"]:
        """Mean return over the last episodes of each evaluation."""
        found: Float64[np.ndarray, "S C E"] = self.returns[..., -episodes:].mean(axis=-1)
        return found

    def by_episode(self) -> tuple[np.ndarray, np.ndarray]:
        """Mean return of each episode, and its standard error: over trainings, or over evaluations of a single training."""
        if len(self.returns) > 1:
            by_training = self.returns.mean(axis=(1, 2))
            return by_training.mean(axis=0), statistics.standard_error(by_training)
        return statistics.mean_and_error(self.returns[0])

    @property
    def flat(self) -> Float[np.ndarray, "T E N"]:
        """The returns with the tasks of all trainings as one axis."""
        return self.returns.reshape(-1, *self.returns.shape[2:])


def returns(frame: pd.DataFrame) -> list[Returns]:
    """The rows of one suite as arrays, by p and agent in the rows' order.

    Raises ConfigError for rows of several suites, methods or problems, and for an agent whose rows are not one
    return for every training, task, evaluation and episode.
    """
    if frame.empty:
        raise ConfigError("result rows: there are none; `icrl-dist evaluate RUN_DIR` writes some")
    for column in ("suite", "tasks", "method", "problem"):
        if len(found := frame[column].unique()) > 1:
            raise ConfigError(
                f"result rows: {column} is {', '.join(map(str, found))}; choose one, as in frame[frame.{column} == ...]"
            )
    groups = [
        (AgentKey(*key[1:]), float(key[0]), rows)
        for key, rows in frame.groupby(["p", "agent", "deployment", "data"], sort=False, dropna=False)
    ]
    named = names(
        list(dict.fromkeys(agent for agent, _, _ in groups)), *(frame[c].iloc[0] for c in ("suite", "method", "problem"))
    )
    return [_arrays(agent, named[agent], p, rows) for agent, p, rows in groups]


def _arrays(agent: AgentKey, name: str, p: float, rows: pd.DataFrame) -> Returns:
    rows = rows.sort_values(_INDEX, kind="stable")
    levels = [np.unique(rows[column]) for column in _INDEX]
    shape = tuple(map(len, levels))
    index = [np.searchsorted(level, rows[column]) for level, column in zip(levels, _INDEX, strict=True)]
    places = np.ravel_multi_index(index, shape)
    if len(rows) != np.prod(shape) or len(np.unique(places)) != len(rows):
        counts = "{} trainings, {} tasks, {} evaluations and {} episodes".format(*shape)
        raise ConfigError(
            f"result rows of {agent.agent}, p = {p:g}: {len(rows)} rows for {counts}, where there should be one row for each "
            "combination: choose rows of runs with different seeds, and of one evaluation by the column evaluation"
        )
    first = rows.iloc[:: shape[2] * shape[3]]
    labels = list(zip(*(first[c] for c in ("split_seed", "task", "adversary_family", "adversary")), strict=True))
    optimum = first["optimum"].to_numpy(float).reshape(shape[:2])
    return Returns(
        agent=agent,
        name=name,
        p=p,
        returns=rows["return"].to_numpy(float).reshape(shape),
        optimum=None if np.isnan(optimum).any() else optimum,
        ceiling=bool(rows["ceiling"].iloc[0]),
        diverged=int(rows["diverged"].sum()),
        training_seeds=tuple(map(int, levels[0])),
        cells=tuple(tuple(labels[i * shape[1] : (i + 1) * shape[1]]) for i in range(shape[0])),
        evaluation_seeds=tuple(map(int, levels[2])),
    )


@dataclass(frozen=True, eq=False)
class Ceiling:
    """What returns are shown as a share of: a reference that is given the task, or the exact optimum."""

    name: str
    scores: Float64[np.ndarray, "S C E"]


def ceilings(found: list[Returns], last: int = LAST) -> dict[float, Ceiling]:
    """By p: the first agent that is given the task (oracle, scripted policy or experts), or else the exact optimum."""
    agents = [one for one in found if one.ceiling]
    if agents:
        return {one.p: Ceiling(one.name, one.scores(last)) for one in agents if one.agent == agents[0].agent}
    exact = [one for one in found if one.optimum is not None]
    return {
        one.p: Ceiling("oracle", np.broadcast_to(one.optimum[..., None], one.returns.shape[:3]))  # type: ignore[index]
        for one in exact
    }


@dataclass(frozen=True)
class Interval:
    """An estimate and its 95% interval."""

    value: float
    low: float
    high: float


def intervals(found: list[Returns], last: int = LAST) -> dict[tuple[float, AgentKey], tuple[Interval, Interval | None]]:
    """By p and agent: the mean return over the last episodes, and its share of the ceiling (None without one).

    The intervals are those of ``statistics.bootstrap``, with the same resamples for all agents at one p.
    """
    best, answer = ceilings(found, last), {}
    for p in dict.fromkeys(one.p for one in found):
        here = [one for one in found if one.p == p]
        scores = [one.scores(last) for one in here] + ([best[p].scores] if p in best else [])
        if any(one.shape != scores[0].shape for one in scores):
            raise ConfigError(
                f"result rows at p = {p:g}: agents differ in trainings, tasks or evaluations; evaluate them together"
            )
        drawn = bootstrap_means(np.stack(scores), here[0].crossed)
        low, high = statistics.interval(drawn)
        for i, one in enumerate(here):
            value = Interval(one.last(last), float(low[i]), float(high[i]))
            share = None
            if p in best:
                top = float(best[p].scores.mean())
                ratios = np.divide(drawn[:, i], drawn[:, -1], out=np.full(len(drawn), np.nan), where=drawn[:, -1] > 0)
                share = Interval(one.last(last) / top if top > 0 else np.nan, *map(float, statistics.interval(ratios)))
            answer[p, one.agent] = value, share
    return answer


def bootstrap_means(scores: Float64[np.ndarray, "A S C E"], crossed: bool) -> Float64[np.ndarray, "R A"]:
    """Resampled means of A agents; equal scores give equal numbers, because the draws are those of one fixed stream."""
    return statistics.bootstrap(scores, statistics.mean, generator(0, RandomKey.RESULTS), crossed=crossed)


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
        "standard_error": [None if np.isnan(e) else round(float(e), 3) for e in error],
        "optimum": None if best is None else round(best, 3),
        "last5": round(last.value, 3),
        "last5_interval": [round(last.low, 3), round(last.high, 3)],
        "last5_over_optimum": None if best is None else _share(last.value, best),
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
    """Mean return over the first episodes, as a share of the oracle's in these episodes; None if that is 0."""
    return _share(float(one.flat[:, :, :episodes].mean()), float(oracle.flat[:, :, :episodes].mean()))


def _share(value: float, whole: float) -> float | None:
    return round(value / whole, 4) if whole else None


def episode_of(one: Returns, oracle: Returns, share: float) -> int | None:
    """First episode, from 1, whose mean return is at least this share of the oracle's mean over all episodes; or None."""
    good = one.flat.mean(axis=(0, 1)) >= share * oracle.flat.mean()
    return int(good.argmax()) + 1 if good.any() else None


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


def label_quality(frame: pd.DataFrame, context_trials: int) -> LabelQuality:
    """Quality of the labels that T^j made in a round, from the rows of suite ``label_quality`` (Theorem E.5).

    ``context_trials``: the first so many trials became contexts; labels come from later ones.
    """
    early = frame["episode"] < context_trials
    by = ["task_index", "adversary_index"]
    variations = frame.groupby(by)[["agreement", "optimum"]].first()
    rated = variations["agreement"].dropna()
    return LabelQuality(
        agreement=float(rated.mean()) if len(rated) else 0.0,
        labelling=len(rated) / len(variations),
        context_return=float(frame[early].groupby(by)["return"].mean().mean()),
        label_return=float(frame[~early].groupby(by)["return"].mean().mean()),
        optimum=float(variations["optimum"].mean()),
    )
