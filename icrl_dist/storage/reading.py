"""The trajectories of a run for analysis: read-only, one at a time, or every step as a row of a DataFrame."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Self

import numpy as np

from icrl_dist.config.paths import folder_of
from icrl_dist.config.run import ConfigError
from icrl_dist.copies import NotCopied
from icrl_dist.storage.dataset import Dataset
from icrl_dist.types import STAGES, Adversary, Identity, Task, Trajectory

if TYPE_CHECKING:
    import pandas as pd


def read_dataset(run_dir: str | Path) -> StoredData:
    """The trajectories that the run in the folder ``run_dir`` collected, also while it is active; nothing on disk is changed.

    Opening reads and checks every segment once.  Trajectories that a disk damaged are left out; ``icrl-dist train
    --resume`` collects them again.
    Raises ConfigError if the folder holds no run, StoreError for a dataset of another format.
    """
    folder = folder_of("run_dir", run_dir)
    if not (folder / "run.toml").is_file():
        raise ConfigError(f"{folder}: holds no run; name a run folder, such as runs/demo")
    return StoredData(Dataset(folder / "dataset", readonly=True))


class StoredData(NotCopied):
    """Trajectories of a run in canonical order: by stage, round, task, variation and trial.

    Iteration reads one trajectory after the other, so the dataset may be larger than the memory.  Use it as a context,
    or call ``close``: its files, one per segment, stay open until then.
    """

    instead = "it holds open files; open the run folder a second time with read_dataset(...)"

    def __init__(self, store: Dataset, chosen: Callable[[Identity], bool] = lambda identity: True) -> None:
        self._store, self._chosen = store, chosen

    def select(
        self,
        stage: str | None = None,
        round: int | None = None,
        task: int | None = None,
        variation: int | None = None,
        trial: int | None = None,
    ) -> StoredData:
        """The trajectories whose identity has these parts; None: any.  The files are shared with this object.

        ``stage``: ``pretrain`` or ``adapt``; the others are numbers from 0.  Raises ConfigError for another stage.
        """
        if stage is not None and stage not in STAGES:
            raise ConfigError(f"stage {stage!r}: choose one of {', '.join(STAGES)}")
        wanted = (stage, round, task, variation, trial)

        def chosen(identity: Identity) -> bool:
            parts = zip(wanted, identity, strict=True)
            return self._chosen(identity) and all(part is None or part == found for part, found in parts)

        return StoredData(self._store, chosen)

    def identities(self) -> Iterator[Identity]:
        """The identities of the trajectories, in canonical order; no trajectory is read."""
        return filter(self._chosen, (row.identity for row in self._store.index))

    def __iter__(self) -> Iterator[Trajectory]:
        """Read one trajectory after the other.  Raises StoreError if the bytes of one changed since the dataset was opened."""
        return map(self._store.read, self.identities())

    def __len__(self) -> int:
        """The number of trajectories."""
        return sum(1 for _ in self.identities())

    def steps(self) -> pd.DataFrame:
        """Every step as one row, in canonical order; docs/data.md explains the columns.  All of them are in memory at once."""
        return _steps(list(self))

    def close(self) -> None:
        """Close the files, also those of selections; nothing can be read afterwards."""
        self._store.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        self.close()


COLUMNS = {
    "stage": "`pretrain` or `adapt`",
    "round": "round of the stage, from 0",
    "task": "number of the task",
    "variation": "number of the variation of the task; 0 is without disturbance",
    "trial": "number of the episode in the variation, from 0",
    "step": "number of the step in the episode, from 0",
    "problem": "name of the problem, such as `darkroom`",
    "task.NAME": "parameter NAME of the task, such as `task.goal`; a list is a tuple",
    "adversary": "family of the adversary, such as `dirichlet`; `null` is no disturbance",
    "adversary.NAME": "parameter NAME of the adversary, such as `adversary.p`; null if its family has no such parameter",
    "observation.I": "component I of the observation before the step, in the environment's unit",
    "action": "number of the agent's action; of a vector in [-1, 1] the components `action.I`",
    "reward": "reward of the step",
    "next_observation.I": "component I of the observation after the step",
    "adversary_action": "number of the action that the adversary executed instead, or of the direction of its wind (0 to 3: "
    "+x, -x, +y, -y); -1 where it did nothing; "
    "of a vector the components `adversary_action.I`",
    "policy_version": "version of the weights that chose the actions; -1 for a policy without weights",
    "weights_digest": "SHA-256 of these weights; empty for a policy without weights",
    "worker": "worker that collected the trajectory",
    "origin": "source of the labels of the trajectory: `optimal`, `heuristic`, `expert` or `none`",
    "queries": "number of labelled query states of the trajectory; the labels themselves are in `Trajectory.labels`",
}
"""The columns of ``StoredData.steps``, in their order."""


def document() -> str:
    """The table of columns in docs/data.md."""
    lines = ["| column | meaning |", "|---|---|"]
    return "\n".join([*lines, *(f"| `{name}` | {meaning} |" for name, meaning in COLUMNS.items())])


def _steps(trajectories: Sequence[Trajectory]) -> pd.DataFrame:
    import pandas as pd

    lengths = [len(one.rewards) for one in trajectories]

    def repeated(values: Iterable[object], dtype: str | None = None) -> pd.Series:
        """One value per trajectory, as one value per step."""
        return pd.Series(list(values), dtype=dtype).repeat(lengths).reset_index(drop=True)

    def parameters(name: str, owners: Sequence[Task] | Sequence[Adversary]) -> dict[str, pd.Series]:
        found = [dict(owner.params) for owner in owners]
        return {f"{name}.{key}": repeated(one.get(key) for one in found) for key in sorted(set().union(*found))}

    def components(name: str, arrays: Sequence[np.ndarray]) -> dict[str, np.ndarray]:
        whole = np.concatenate(arrays) if arrays else np.empty(0)
        return {name: whole} if whole.ndim == 1 else {f"{name}.{i}": column for i, column in enumerate(whole.T)}

    tasks = [one.variation.task for one in trajectories]
    adversaries = [one.variation.adversary for one in trajectories]
    return pd.DataFrame(
        {
            "stage": repeated((one.identity.stage for one in trajectories), "category"),
            **{name: repeated((getattr(one.identity, name) for one in trajectories), "int64") for name in Identity._fields[1:]},
            "step": np.concatenate([np.arange(length) for length in lengths]) if lengths else np.empty(0, np.int64),
            "problem": repeated((task.kind for task in tasks), "category"),
            **parameters("task", tasks),
            "adversary": repeated((adversary.kind for adversary in adversaries), "category"),
            **parameters("adversary", adversaries),
            **components("observation", [one.observations[:-1] for one in trajectories]),
            **components("action", [one.actions for one in trajectories]),
            **components("reward", [one.rewards for one in trajectories]),
            **components("next_observation", [one.observations[1:] for one in trajectories]),
            **components("adversary_action", [one.adversary for one in trajectories]),
            "policy_version": repeated((one.policy_version for one in trajectories), "int64"),
            "weights_digest": repeated((one.weights_digest for one in trajectories), "category"),
            "worker": repeated((one.worker for one in trajectories), "category"),
            "origin": repeated((one.origin for one in trajectories), "category"),
            "queries": repeated((len(one.queries) for one in trajectories), "int64"),
        }
    )
