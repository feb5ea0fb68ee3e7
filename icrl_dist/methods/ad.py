"""Algorithm Distillation (Laskin et al. 2022): imitates a learning agent, so that the model learns in its context."""

from __future__ import annotations

import functools
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

import numpy as np

from icrl_dist.config.q_learning import QLearning
from icrl_dist.config.ranges import Positive
from icrl_dist.config.run import Run
from icrl_dist.config.sections import Deployment, ModelConfig
from icrl_dist.interfaces import Draw, LearningHistories, Method, Phase, TrajectoryDataset, UsedLabels
from icrl_dist.methods import jobs
from icrl_dist.methods.dpt import DPT, no_dagger, pretrain_phase
from icrl_dist.problems import registry
from icrl_dist.types import Job, Task, Trajectory, Variation

if TYPE_CHECKING:
    from icrl_dist.training.batches import Examples
    from icrl_dist.training.history_windows import HistoryWindows


@dataclass(frozen=True)
class ADConfig(QLearning):
    """Algorithm Distillation: histories of a learning agent, and windows of them.

    The settings of ``QLearning`` decide how histories are made in a problem where tabular Q-learning makes them.
    """

    variations: Literal["undisturbed", "icag"] = "undisturbed"
    """Variations in which the agent learns: ``undisturbed`` tasks, or those of ICAG."""
    window_episodes: Positive = 8
    """Episodes in a training context, in the order in which the agent learned."""
    skip: Positive = 8
    """A window holds every so-many-th episode of a history, so that a short window shows much progress."""
    history_episodes: Positive = 60
    """Episodes of a history of Q-learning, at least; a variation with twice as many episodes or more has several."""


class AD(DPT):
    """Next-action prediction over windows of several episodes of one history, with DPT's model and loss."""

    name = "ad"
    section = "ad"
    Config = ADConfig
    distributions = Method.distributions  # type: ignore[assignment]  # a perfect model is far from the exact posterior

    def objections(self, run: Run) -> Iterator[tuple[str, object, str]]:
        yield from no_dagger(run)
        if run.model.window > 1:
            yield "model.window", run.model.window, "use 1: histories of ad have no action windows"
        found, of = self._histories(run), run.section(self.section)
        if found is None:
            yield "method", run.method, f"{run.problem} records no histories of a learning agent: use dpt, icag or icaa"
        elif (shortest := found.trials // found.count) < (span := self._windows(run, found).span):
            text = f"every {of.skip}th of {span} episodes" if of.skip > 1 else f"{span} episodes"
            advice = f"a window takes {text}, and a history has {shortest}; use fewer, a smaller ad.skip or"
            yield "ad.window_episodes", of.window_episodes, f"{advice} more pretrain.contexts"

    def training_variations(self, run: Run, index: int, task: Task, round: int) -> tuple[Variation, ...]:
        """Only the task under the null adversary, or ICAG's variations (``ad.variations``)."""
        if run.section(self.section).variations == "icag":
            return registry.training_variations(run, index, task, round)
        return (Variation(task),)

    def phases(self, run: Run) -> tuple[Phase, ...]:
        """The fit to the histories."""
        return (pretrain_phase(run),)

    def ask(self, run: Run, phase: Phase) -> tuple[Job, ...]:
        """Jobs of histories in every variation; episodes start as test episodes do."""
        found = self._histories(run)
        assert found is not None, "objections refuses a problem without histories"
        return jobs.grouped(
            run, phase, jobs.at_test_start(run, functools.partial(self._choose, run)), found.trials, found.payload
        )

    def data(self, run: Run, phase: Phase, dataset: TrajectoryDataset) -> Draw:
        """Draws windows of the histories."""
        from icrl_dist.methods import examples
        from icrl_dist.training import history_windows
        from icrl_dist.training.batches import CachedExamples

        histories = self._histories(run)
        assert histories is not None, "objections refuses a problem without histories"
        windows = self._windows(run, histories)
        cache = examples.cache(run, dataset, _imitated)
        keys = dataset.variations(phase.stage, phase.round)
        batch, length = run.optim.batch, windows.episodes * registry.of(run).horizon
        if run.optim.transitions:
            batch = max(1, min(batch, run.optim.transitions // length))
        return functools.partial(
            history_windows.draw,
            examples=CachedExamples(cache, keys),
            windows=windows,
            batch=batch,
            queries=run.optim.queries,
        )

    def rule(self, model: ModelConfig) -> Deployment:
        return "growing"

    def used_labels(self, run: Run, phase: Phase, job: Job) -> UsedLabels:
        """The actions of all episodes."""
        return UsedLabels("learner's actions", job.trials)

    def _histories(self, run: Run) -> LearningHistories | None:
        """The histories of each variation; all variations together have at most ``pretrain.contexts`` episodes."""
        problem = registry.of(run)
        count = len(self.training_variations(run, 0, problem.split.train[0], 0)) * problem.train_count
        return problem.learning_histories(run, max(1, run.pretrain.contexts // count))

    def _windows(self, run: Run, histories: LearningHistories) -> HistoryWindows:
        from icrl_dist.training.history_windows import HistoryWindows

        of = run.section(self.section)
        return HistoryWindows(histories.count, of.window_episodes, of.skip)


def _imitated(run: Run, trials: Sequence[Trajectory]) -> Examples:
    """The episodes of a variation; every state is a query, and the action there its label."""
    from icrl_dist.training.batches import Examples

    states = np.concatenate([t.observations[:-1] for t in trials])
    actions = np.concatenate([t.actions for t in trials])
    labels = actions if actions.ndim == 2 else np.eye(registry.of(run).spec.actions, dtype=np.float32)[actions]
    return Examples.of(trials, states, labels, history=True)
