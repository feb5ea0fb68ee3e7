"""ICAA (section 4.2, Algorithm 3): D^0 is the dataset of DPT; in each round the model labels its own rollouts."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING

from icrl_dist.config.run import Run
from icrl_dist.interfaces import Draw, Phase, RatedVariation, TrajectoryDataset, UsedLabels, VariationKey
from icrl_dist.methods import jobs
from icrl_dist.methods.dpt import DPT, no_dagger, pretrain_phase
from icrl_dist.problems import registry
from icrl_dist.types import Job, Task, Trajectory, Variation

if TYPE_CHECKING:
    from icrl_dist.training.batches import Examples, ExamplesCache


class ICAA(DPT):
    """In-Context Adversarial Adaptation.  The labels of a round are computed once."""

    name = "icaa"

    def __init__(self) -> None:
        self._cache: ExamplesCache[VariationKey] | None = None
        self._gives_labels: dict[VariationKey, bool] = {}

    def training_variations(self, run: Run, index: int, task: Task, round: int) -> tuple[Variation, ...]:
        """All variations, with new adversaries in every round (line 11)."""
        return registry.training_variations(run, index, task, round)

    def objections(self, run: Run) -> Iterator[tuple[str, object, str]]:
        """Labels that compare actions need the same state again, and no labels along action windows."""
        yield from no_dagger(run)
        icaa, problem = run.icaa, registry.of(run)
        if icaa.explore and not problem.spec.discrete:
            yield "icaa.explore", icaa.explore, "only discrete actions can be random ones; use 0"
        if icaa.labels == "actions":
            if icaa.context == "any":
                yield "icaa.context", icaa.context, "its contexts hold the trials that label; use history, or other icaa.labels"
            return
        if not problem.spec.discrete or problem.limits.reward[0] < 0:
            yield "icaa.labels", icaa.labels, f"{run.problem} needs discrete actions and no negative rewards; use actions"
        if icaa.label_trials != "later":
            yield "icaa.label_trials", icaa.label_trials, f'icaa.labels = "{icaa.labels}" compares all trials; use later'
        if run.model.window > 1:
            yield "icaa.labels", icaa.labels, "it labels states, not action windows; use actions, or model.window = 1"

    def phases(self, run: Run) -> tuple[Phase, ...]:
        """Lines 3 and 5: T^0 from D^0, then rounds j = 0..J."""
        icaa = run.icaa
        rounds = (Phase("adapt", j, icaa.steps, icaa.learning_rate) for j in range(icaa.rounds + 1))
        return (pretrain_phase(run), *rounds)

    def ask(self, run: Run, phase: Phase) -> tuple[Job, ...]:
        """Lines 8 to 12: jobs that deploy T^j in every variation for N + 1 trials."""
        if phase.stage == "pretrain":
            return jobs.pretraining_contexts(run, phase, lambda index, task: (Variation(task),))

        def choose(index: int, task: Task) -> tuple[Variation, ...]:
            return self.training_variations(run, index, task, phase.round)

        icaa = run.icaa
        return jobs.rollouts(run, phase, choose, icaa.trials + 1, self.deployment(run), icaa.explore, icaa.context_trials + 1)

    def data(self, run: Run, phase: Phase, dataset: TrajectoryDataset) -> Draw:
        """Lines 13 to 19: contexts are the first trials, labels come from later ones; D_pre is the union over rounds."""
        from icrl_dist.methods import examples
        from icrl_dist.training.batches import CachedExamples, Pool

        cache = self._examples(run, dataset)
        pretrain = Pool(1.0, CachedExamples(cache, dataset.variations("pretrain", 0)), run.optim.episodes)
        rounds = range(phase.round + 1) if phase.stage == "adapt" else ()
        adapted = [key for j in rounds for key in dataset.variations("adapt", j)]
        labelling = [key for key in adapted if self._has_labels(run, dataset, key)]
        if not labelling:
            return examples.draw(run, [pretrain])
        share = run.icaa.new_fraction
        episodes = 1 if run.icaa.context == "trial" else run.icaa.context_trials + 1
        self_labelled = Pool(share, CachedExamples(cache, labelling), episodes)
        return examples.draw(run, [dataclasses.replace(pretrain, share=1 - share), self_labelled])

    def used_labels(self, run: Run, phase: Phase, job: Job) -> UsedLabels | None:
        """In a round the actions of the trials that ``icaa.label_trials`` selects, of ``improved`` ones at most all.

        Labels that compare actions use all N + 1 trials.
        """
        if phase.stage == "pretrain":
            return super().used_labels(run, phase, job)
        if run.icaa.labels != "actions":
            return UsedLabels(f"own {run.icaa.labels}", run.icaa.trials + 1)
        later = run.icaa.trials - run.icaa.context_trials
        return UsedLabels("own actions", (later + 1) // 2 if run.icaa.label_trials == "top_return" else later)

    def label_quality(self, run: Run, phase: Phase, dataset: TrajectoryDataset) -> Iterator[RatedVariation]:
        """The variations that T^j labelled in a round, one at a time, compared with exact answers (Theorem E.5).

        None in D^0, and none for a problem without exact answers.
        """
        exact = registry.of(run).exact
        if phase.stage != "adapt" or exact is None:
            return
        for key in dataset.variations(phase.stage, phase.round):
            trials, agreement = dataset.trials(key), None
            if self._has_labels(run, dataset, key, trials):
                found = self._examples(run, dataset).get(key)
                agreement = float(exact.optimal(trials[0].variation, found.queries, found.labels).mean())
            optimum = float(exact.optimum([trials[0].variation])[0])
            yield RatedVariation(trials, optimum, agreement, run.icaa.context_trials + 1)

    def _examples(self, run: Run, dataset: TrajectoryDataset) -> ExamplesCache[VariationKey]:
        from icrl_dist.methods import examples

        def make(run: Run, trials: Sequence[Trajectory]) -> Examples | None:
            return (examples.self_labelled if trials[0].origin == "none" else examples.labelled)(run, trials)

        if self._cache is None:
            self._cache = examples.cache(run, dataset, make)
        return self._cache

    def _has_labels(
        self, run: Run, dataset: TrajectoryDataset, key: VariationKey, trials: Sequence[Trajectory] | None = None
    ) -> bool:
        """Whether a variation gives labels.  Computed once; the examples are put into the cache."""
        from icrl_dist.methods import examples

        if key not in self._gives_labels:
            found = examples.self_labelled(run, dataset.trials(key) if trials is None else trials)
            self._gives_labels[key] = found is not None
            if found is not None:
                self._examples(run, dataset).put(key, found)
        return self._gives_labels[key]
