"""Result rows of episodes that a training collected itself: self-labelled rollouts, and histories of experts."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from icrl_dist.config.run import Run
from icrl_dist.interfaces import LabelQuality, Phase, RatedVariation
from icrl_dist.methods import registry as methods
from icrl_dist.results import rows, summaries
from icrl_dist.results.evaluate import of_run, parameters
from icrl_dist.results.names import key_of
from icrl_dist.results.rows import Block
from icrl_dist.types import Trajectory


def rate_labels(
    run: Run, folder: Path, phase: Phase, rated: Iterable[RatedVariation], note: Callable[[str], None]
) -> LabelQuality | None:
    """Write the trials of one round as rows of suite ``label_quality``; returns ``summaries.label_quality`` of them.

    Without trials nothing is written and the result is None.  If the rows cannot be written, ``note`` is called with the
    reason in one line and the result is None: training needs no rows, and after a resume the same error would come again.
    """
    rule, blocks = methods.of(run).deployment(run), []
    for one in rated:
        became = ["context" if trial.identity.trial < one.context_trials else "labels" for trial in one.trials]
        blocks.append(
            {
                **_of_trials(run, folder.resolve().name, one.trials),
                "agent": np.array([key_of(trial.policy_version) for trial in one.trials], object),
                "policy_version": np.array([trial.policy_version for trial in one.trials]),
                "weights_digest": np.array([trial.weights_digest for trial in one.trials], object),
                "deployment": rule,
                "data": np.array(became, object),
                "optimum": one.optimum,
                "agreement": one.agreement,
            }
        )
    if not blocks:
        return None
    try:
        file = rows.append(folder / "results", "label_quality", {"round": phase.round}, blocks)
        return summaries.label_quality(rows.read([file]))
    except Exception as error:
        note(f"round {phase.round}: its label quality is not stored, and training goes on: {' '.join(str(error).split())}")
        return None


def of_expert(run: Run, name: str, trials: Sequence[Trajectory]) -> Block:
    """The recorded episodes of one expert's training, or of one robust policy.  ``name``: of the run."""
    return {
        **_of_trials(run, name, trials),
        "agent": methods.of(run).product,
        "policy_version": -1,
        "weights_digest": "",
        "deployment": "",
    }


def _of_trials(run: Run, name: str, trials: Sequence[Trajectory]) -> dict[str, Any]:
    """The columns of trials in one training variation that do not depend on the agent."""
    identity, variation = trials[0].identity, trials[0].variation
    return {
        **of_run(run, name),
        "tasks": "train",
        "ceiling": False,
        "data": "",
        "prior": "",
        "task_index": identity.task,
        "task": parameters(variation.task),
        "adversary_family": variation.adversary.kind,
        "adversary_index": identity.variation,
        "adversary": parameters(variation.adversary),
        "evaluation_seed": 0,
        "episode": np.array([trial.identity.trial for trial in trials]),
        "return": np.array([trial.episode_return for trial in trials], float),
        "diverged": False,
    }
