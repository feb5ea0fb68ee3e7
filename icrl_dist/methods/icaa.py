"""ICAA (section 4.2, Algorithm 3): D^0 is DPT's dataset; then, round by round, the model labels its own rollouts."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from icrl_dist.config.run import Run
from icrl_dist.interfaces import Draw, Phase, TrajectoryDataset, VariationKey
from icrl_dist.methods import jobs
from icrl_dist.methods.dpt import DPT, pretrain_phase
from icrl_dist.problems import registry
from icrl_dist.types import Job, Task, Trajectory, Variation

if TYPE_CHECKING:
    from icrl_dist.training.batches import Examples, Shelf


class ICAA(DPT):
    """In-Context Adversarial Adaptation; labels of every round are computed once."""

    name = "icaa"

    def __init__(self) -> None:
        self._shelf: Shelf[VariationKey] | None = None
        self._gives_labels: dict[VariationKey, bool] = {}

    def training_variations(self, run: Run, index: int, task: Task, round: int) -> tuple[Variation, ...]:
        """K variations, with new adversaries in every round (line 11)."""
        return registry.training_variations(run, index, task, round)

    def phases(self, run: Run) -> tuple[Phase, ...]:
        """Lines 3 and 5: T^0 from D^0, then rounds j = 0..J."""
        of = run.icaa
        return (pretrain_phase(run), *(Phase("adapt", j, of.steps, of.learning_rate) for j in range(of.rounds + 1)))

    def ask(self, run: Run, phase: Phase) -> tuple[Job, ...]:
        """Lines 8 to 12: T^j is deployed in every variation for N + 1 trials."""
        if phase.stage == "pretrain":
            return jobs.pretraining_contexts(run, phase, lambda index, task: (Variation(task),))

        def choose(index: int, task: Task) -> tuple[Variation, ...]:
            return self.training_variations(run, index, task, phase.round)

        return jobs.rollouts(run, phase, choose, run.icaa.trials + 1, self.deployment(run))

    def data(self, run: Run, phase: Phase, dataset: TrajectoryDataset) -> Draw:
        """Lines 13 to 19: contexts from the first trials, labels from later ones, D_pre the union."""
        from icrl_dist.methods import examples
        from icrl_dist.training.batches import Pool, Shelved

        shelf = self._shelf_of(run, dataset)
        pretrain, episodes = Shelved(shelf, dataset.variations("pretrain", 0)), run.optim.episodes
        rounds = range(phase.round + 1) if phase.stage == "adapt" else ()
        labelling = [key for j in rounds for key in dataset.variations("adapt", j) if self._labelled(run, dataset, key)]
        if not labelling:
            return examples.draw(run, [Pool(1.0, pretrain, episodes)])
        share = run.icaa.new_fraction
        return examples.draw(run, [Pool(1 - share, pretrain, episodes), Pool(share, Shelved(shelf, labelling), episodes)])

    def label_quality(self, run: Run, phase: Phase, dataset: TrajectoryDataset) -> dict[str, float]:
        """How good a round's own labels are beside the exact answer (Theorem E.5, measured).

        ``agreement``: share of labels that are optimal; ``labelling``: share of the variations that gave
        labels; mean returns of the trials that became contexts and of the later ones; the optimum beside
        them.  Empty for D^0, and for a problem without exact answers.
        """
        exact = registry.of(run).exact
        if phase.stage != "adapt" or exact is None:
            return {}
        agreement, early, late, best = [], [], [], []
        cut = run.icaa.context_trials + 1
        for key in dataset.variations(phase.stage, phase.round):
            trials = dataset.trials(key)
            if self._labelled(run, dataset, key, trials):
                own = self._shelf_of(run, dataset).get(key)
                agreement.append(exact.optimal(trials[0].variation, own.queries, own.labels).mean())
            early.append(np.mean([t.episode_return for t in trials[:cut]]))
            late.append(np.mean([t.episode_return for t in trials[cut:]]))
            best.append(exact.optimum([trials[0].variation])[0])
        return {
            "agreement": float(np.mean(agreement)) if agreement else 0.0,
            "labelling": len(agreement) / len(early),
            "context_return": float(np.mean(early)),
            "label_return": float(np.mean(late)),
            "optimum": float(np.mean(best)),
        }

    def _shelf_of(self, run: Run, dataset: TrajectoryDataset) -> Shelf[VariationKey]:
        from icrl_dist.methods import examples

        def made(run: Run, trials: Sequence[Trajectory]) -> Examples | None:
            return (examples.self_labelled if trials[0].origin == "none" else examples.labelled)(run, trials)

        if self._shelf is None:
            self._shelf = examples.shelf(run, dataset, made)
        return self._shelf

    def _labelled(
        self, run: Run, dataset: TrajectoryDataset, key: VariationKey, trials: Sequence[Trajectory] | None = None
    ) -> bool:
        """Whether a variation gives labels; computed once a run."""
        from icrl_dist.methods import examples

        if key not in self._gives_labels:
            found = examples.self_labelled(run, dataset.trials(key) if trials is None else trials)
            self._gives_labels[key] = found is not None
            if found is not None:
                self._shelf_of(run, dataset).put(key, found)
        return self._gives_labels[key]
