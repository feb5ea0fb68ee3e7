"""Result rows as arrays: the returns of one agent by training, task, evaluation and episode, and which rows are partners."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float, Float64

from icrl_dist.config.run import ConfigError
from icrl_dist.results import statistics
from icrl_dist.results.names import AgentKey, names

if TYPE_CHECKING:
    import pandas as pd

LAST = 5
"""Episodes at the end of an evaluation whose mean return is shown."""
Cell = tuple[object, object, tuple[tuple[object, object], ...]]
"""A task as it was evaluated: split seed, parameters, and the adversary of each evaluation (family and parameters)."""
_INDEX = ["training_seed", "task_index", "evaluation_seed", "episode"]
_SETTING = ("suite", "tasks", "method", "problem", "prior")


@dataclass(frozen=True, eq=False)
class Returns:
    """The rows of one agent at one p as arrays: S trainings, C tasks, E evaluations of each, N episodes an evaluation."""

    agent: AgentKey
    name: str
    """What tables call the agent."""
    p: float
    returns: Float64[np.ndarray, "S C E N"]
    optimum: Float64[np.ndarray, "S C E"] | None
    """Expected return of the optimal policy; None if it is not known."""
    ceiling: bool
    """The agent is given the task, so other returns are also shown as a share of its returns."""
    diverged: int
    """Episodes in which the simulation diverged."""
    training_seeds: tuple[int, ...]
    cells: tuple[tuple[Cell, ...], ...]
    """By training and task."""
    evaluation_seeds: tuple[int, ...]
    setting: dict[str, str]
    """Suite, tasks, method, problem and prior of the rows."""
    certified: Float64[np.ndarray, "S C E N"]
    """The column ``certified``; nan where it has no value."""

    @property
    def crossed(self) -> bool:
        """Whether all trainings were evaluated on the same tasks.

        Their adversaries may differ, because they are drawn from the seed of the run.
        """
        tasks = [[cell[:2] for cell in training] for training in self.cells]
        return all(training == tasks[0] for training in tasks)

    @property
    def draws(self) -> int:
        """The largest number of different adversaries that one task was evaluated under."""
        return max(len(set(adversaries)) for training in self.cells for _, _, adversaries in training)

    def worst_sampled(self, episodes: int = LAST) -> float:
        """Mean return over the last episodes under the sampled adversary that lowers it most, averaged over tasks.

        It estimates the worst case from few draws: the minimum of noisy means lies below the smallest true mean, and the
        worst adversary of all may be worse.
        """
        lowest = []
        for training, scores in zip(self.cells, self.scores(episodes), strict=True):
            for (_, _, adversaries), of_task in zip(training, scores, strict=True):
                alike = [[a == b for b in adversaries] for a in dict.fromkeys(adversaries)]
                lowest.append(min(of_task[np.array(of)].mean() for of in alike))
        return float(np.mean(lowest))

    def certificate(self, episodes: int = LAST) -> float | None:
        """Mean certified return over the last episodes; None if any of them has none."""
        found = self.certified[..., -episodes:].mean()
        return None if np.isnan(found) else float(found)

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

    Raises ConfigError for rows without p; for rows of several suites, sets of tasks, methods, problems or priors; for a
    training seed with rows of several runs, or of several weights of one agent; and for an agent whose rows are not
    one return for every training, task, evaluation and episode.
    """
    if frame.empty:
        raise ConfigError("result rows: there are none; `icrl-dist evaluate RUN_DIR` writes some")
    for column in _SETTING:
        if len(found := frame[column].unique()) > 1:
            raise ConfigError(
                f"result rows: {column} is {', '.join(map(str, found))}; choose one, as in frame[frame.{column} == ...]"
            )
    setting = {column: str(frame[column].iloc[0]) for column in _SETTING}
    if frame["p"].isna().any():
        raise ConfigError(
            f"result rows of suite {setting['suite']} have no p, because their adversaries are of training: choose rows of "
            "another suite, as in frame[frame.suite == 'online']"
        )
    _check_one_source(frame)
    groups = [
        (AgentKey(*key[1:]), float(key[0]), rows)
        for key, rows in frame.groupby(["p", "agent", "deployment", "data"], sort=False, dropna=False)
    ]
    named = names(list(dict.fromkeys(agent for agent, _, _ in groups)), *(setting[c] for c in ("suite", "method", "problem")))
    return [_arrays(agent, named[agent], p, rows, setting) for agent, p, rows in groups]


def _check_one_source(frame: pd.DataFrame) -> None:
    for column, by in (("run", ["training_seed"]), ("weights_digest", ["training_seed", "agent"])):
        for key, found in frame.groupby(by)[column].unique().items():
            if len(found) > 1:
                whose = ", ".join(map(str, key if isinstance(key, tuple) else (key,)))
                raise ConfigError(
                    f"result rows of training seed {whose}: {column} is {', '.join(found)}; choose rows of runs with different "
                    f"seeds, or one, as in frame[frame.{column} == ...]"
                )


def _arrays(agent: AgentKey, name: str, p: float, rows: pd.DataFrame, setting: dict[str, str]) -> Returns:
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
    for column, level in zip(_INDEX[2:], levels[2:], strict=True):
        if level[0] != 0 or level[-1] != len(level) - 1:
            raise ConfigError(
                f"result rows of {agent.agent}, p = {p:g}: {column} is {level[0]} to {level[-1]}, {len(level)} numbers, where "
                f"it should be 0 to {len(level) - 1}: choose whole evaluations by the column evaluation"
            )
    first = rows.iloc[:: shape[3]]
    splits = first["split_seed"].astype(object).where(first["split_seed"].notna(), None).tolist()
    adversaries = list(zip(first["adversary_family"], first["adversary"], strict=True))
    cells = [
        (splits[row], first["task"].iloc[row], tuple(adversaries[row : row + shape[2]]))
        for row in range(0, len(first), shape[2])
    ]
    optimum = first["optimum"].to_numpy(float).reshape(shape[:3])
    return Returns(
        agent=agent,
        name=name,
        p=p,
        returns=rows["return"].to_numpy(float).reshape(shape),
        optimum=None if np.isnan(optimum).any() else optimum,
        ceiling=bool(rows["ceiling"].iloc[0]),
        diverged=int(rows["diverged"].sum()),
        training_seeds=tuple(map(int, levels[0])),
        cells=tuple(tuple(cells[i * shape[1] : (i + 1) * shape[1]]) for i in range(shape[0])),
        evaluation_seeds=tuple(map(int, levels[2])),
        setting=setting,
        certified=rows["certified"].to_numpy(float).reshape(shape),
    )


def check_pairs(first: Returns, second: Returns) -> None:
    """Raises ConfigError, with the first difference, unless every row of one agent has a partner in the other.

    Partners have equal suite, tasks, problem, prior, training seed, split seed, task, adversary, evaluation seed and episode.
    """
    different = [
        *((name, one, second.setting[name]) for name, one in first.setting.items() if name != "method"),
        ("training seeds", first.training_seeds, second.training_seeds),
        ("evaluation seeds", first.evaluation_seeds, second.evaluation_seeds),
        ("episodes", first.returns.shape[3], second.returns.shape[3]),
        ("tasks", len(first.cells[0]), len(second.cells[0])),
    ]
    for what, one, two in different:
        if one != two:
            raise ConfigError(
                f"result rows at p = {first.p:g}: {what} are {one} of {first.name} and {two} of {second.name}, so rows have no "
                "partner: choose rows that both have, as of one evaluation in read_results(..., all=True)"
            )
    for seed, ones, twos in zip(first.training_seeds, first.cells, second.cells, strict=True):
        for index, (here, there) in enumerate(zip(ones, twos, strict=True)):
            if here != there:
                raise ConfigError(
                    f"result rows at p = {first.p:g}, training seed {seed}, task {index}: {first.name} has "
                    f"{_cell(here, there)} and {second.name} has {_cell(there, here)}: pairs need equal split seed, task and "
                    "adversary in every evaluation; evaluate both alike"
                )


def _cell(cell: Cell, other: Cell) -> str:
    """The cell with the first of its adversaries that the other one does not have in the same evaluation."""
    split, task, adversaries = cell
    draw = next((i for i, (a, b) in enumerate(zip(adversaries, other[2], strict=True)) if a != b), 0)
    family, parameters = adversaries[draw]
    return f"split seed {split}, task {task}, in evaluation {draw} adversary {family} {parameters}"
