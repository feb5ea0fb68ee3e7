"""A user's script with every public name and its type; mypy reads it (tests/test_public.py), nothing runs it."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any, assert_type

import gymnasium
import numpy as np
import pandas as pd
import torch
from rich.table import Table

import icrl_dist


def show(event: dict[str, Any]) -> None:
    print(event["event"])


def train(run_file: Path) -> icrl_dist.TrainResult | None:
    run: icrl_dist.Run = icrl_dist.load_run(run_file, "icaa.rounds=2", "seed=3")
    assert_type(run.icaa.rounds, int)
    try:
        made = icrl_dist.train(run, "runs/mine", engine="inline", overwrite=True, progress=show)
    except icrl_dist.TrainInterrupted as error:
        assert_type(error.resumable, bool)
        return None
    except (icrl_dist.ConfigError, icrl_dist.TrainFailed, icrl_dist.StoreError):
        return None
    assert_type(made.folder, Path)
    assert_type(made.result, dict[str, Any])
    assert_type(made.quarantined, list[dict[str, Any]])
    assert_type(made.evaluation, icrl_dist.Evaluation)
    return icrl_dist.train("smoke", engine="ray", actors=1, resume=True, source="runs/mine@0", progress=True)


def sweep(file: Path) -> list[dict[str, str]]:
    found: icrl_dist.SweepResult = icrl_dist.sweep(file, only=["dpt"], seeds=[0], jobs=2, keep="rows")
    assert_type(found.out, Path)
    assert_type(found.runs, list[dict[str, Any]])
    return found.failed


def evaluate(folder: Path) -> pd.DataFrame:
    found = icrl_dist.evaluate(folder, suite="offline", deploy="paper", episodes=2, seeds=1, p=[0.0, 0.2], prior="uniform")
    assert_type(found.tables, tuple[Table, ...])
    assert_type(found.figure, Path | None)
    assert_type(found.summary, dict[str, Any])
    return found.rows


def results(folders: list[str]) -> Table:
    frame: pd.DataFrame = icrl_dist.read_results(folders)
    print(icrl_dist.report("runs/sweep", figure="3c", common_seeds=True).summary)
    return icrl_dist.compare(frame, frame, names=("one", "other"))


def trajectories(folder: str) -> Iterator[icrl_dist.Trajectory]:
    data: icrl_dist.StoredData
    with icrl_dist.read_dataset(folder) as data:
        for identity in data.select(stage="adapt", round=1).identities():
            assert_type(identity, icrl_dist.Identity)
        frame: pd.DataFrame = data.steps()
        print(len(frame))
        yield from data


def act() -> float:
    agent: icrl_dist.InContextAgent = icrl_dist.load_agent("darkroom", seed=0, threads=2)
    assert_type(agent.model, torch.nn.Module)
    task = icrl_dist.Task.of("darkroom", goal=(3, 4), size=10, horizon=100, start=(0, 0))
    variation = icrl_dist.Variation(task, icrl_dist.Adversary.of("uniform", p=0.2))
    env = icrl_dist.make(variation)
    assert isinstance(env, gymnasium.Env)
    undisturbed = icrl_dist.Variation(task, icrl_dist.NULL)
    hypotheses = icrl_dist.oracle.Hypotheses.of([variation, undisturbed])
    print(icrl_dist.oracle.optimal_returns(hypotheses))
    obs, _ = env.reset(seed=0)
    (action,) = agent.act([obs])
    following, reward, _, done, _ = env.step(action)
    agent.observe([obs], [action], [float(reward)], [following], [done])
    return float(np.asarray(agent.surprise)[0])


def plug_in(problem: type[icrl_dist.Problem], method: type[icrl_dist.Method]) -> tuple[str, str]:
    return problem.section, method.name
