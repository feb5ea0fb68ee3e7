"""DPT (section 2): tasks without disturbance, labels from each task's optimal policy."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float32, Float64, Int64

from icrl_dist.config.run import Run
from icrl_dist.config.sections import ContextConfig, Deployment
from icrl_dist.interfaces import Draw, Method, Phase, TrajectoryDataset, Watch
from icrl_dist.methods import jobs
from icrl_dist.types import Job, Spec, Task, Variation

if TYPE_CHECKING:
    import torch

    from icrl_dist.models.dpt import PretrainedTransformer
    from icrl_dist.rollout.deployment import InContextPolicy
    from icrl_dist.training.batches import TrainingBatch


def pretrain_phase(run: Run) -> Phase:
    """The fit to D_pre."""
    return Phase("pretrain", 0, run.pretrain.steps, run.optim.learning_rate)


class DPT(Method):
    """Decision-pretrained transformer; the base of ICAG and ICAA, which share its model, loss and policy."""

    name = "dpt"
    shows_states = True

    def training_variations(self, run: Run, index: int, task: Task, round: int) -> tuple[Variation, ...]:
        """The task without disturbance."""
        return (Variation(task),)

    def phases(self, run: Run) -> tuple[Phase, ...]:
        """The fit to D_pre, then the DAgger rounds, of which the paper has none."""
        of = run.dagger
        return (pretrain_phase(run), *(Phase("adapt", j, of.steps, of.learning_rate) for j in range(of.rounds)))

    def ask(self, run: Run, phase: Phase) -> tuple[Job, ...]:
        """Contexts and labels of every variation; in a DAgger round histories of T^j with the same labels.

        A model with action windows is deployed by Algorithm 1 in two of three jobs, because those histories
        differ most from D_pre.
        """
        choose = functools.partial(self._choose, run)
        if phase.stage == "pretrain":
            return jobs.pretraining_contexts(run, phase, choose)
        rules: tuple[Deployment, ...] = ("paper", "committed", "paper") if run.model.window > 1 else ("paper",)
        return jobs.dagger_rollouts(run, phase, choose, rules)

    def _choose(self, run: Run, index: int, task: Task) -> tuple[Variation, ...]:
        return self.training_variations(run, index, task, 0)

    def data(self, run: Run, phase: Phase, dataset: TrajectoryDataset) -> Draw:
        """D_pre, and in a DAgger round the histories of this and all earlier rounds."""
        from icrl_dist.methods import examples
        from icrl_dist.training.batches import Pool, Shelved

        shelf = examples.shelf(run, dataset, examples.labelled)
        pretrain = Pool(1.0, Shelved(shelf, dataset.variations("pretrain", 0)), run.optim.episodes)
        if phase.stage == "pretrain":
            return examples.draw(run, [pretrain])
        histories = [key for j in range(phase.round + 1) for key in dataset.variations("adapt", j)]
        share = run.dagger.new_fraction
        both = [dataclasses.replace(pretrain, share=1 - share), Pool(share, Shelved(shelf, histories), run.dagger.trials)]
        return examples.draw(run, both)

    def build(self, spec: Spec, run: Run) -> PretrainedTransformer:
        from icrl_dist.models.dpt import PretrainedTransformer

        return PretrainedTransformer(spec, run.model)

    def loss(self, model: PretrainedTransformer, batch: TrainingBatch) -> torch.Tensor:
        """Eq. (1), with action windows also eq. (6)."""
        from icrl_dist.methods.dpt_loss import batch_loss

        return batch_loss(model, batch)

    def deployment(self, run: Run) -> Deployment:
        return "committed" if run.model.window > 1 else "paper"

    def policy(
        self,
        model: PretrainedTransformer,
        batch: int,
        context: ContextConfig,
        deploy: Deployment | None = None,
        watch: Watch | None = None,
    ) -> InContextPolicy:
        from icrl_dist.rollout.deployment import in_context

        return in_context(model, batch, context, deploy, watch)

    def distributions(
        self,
        model: PretrainedTransformer,
        transitions: Sequence[np.ndarray],
        queries: Float32[np.ndarray, "B N S"],
        prefix: Int64[np.ndarray, "B N"],
    ) -> Float64[np.ndarray, "B N A"]:
        import torch

        from icrl_dist.models.dpt import Transitions

        with torch.inference_mode():
            *context, asked, seen = (torch.from_numpy(a).to(model.low.device) for a in (*transitions, queries, prefix))
            logits: torch.Tensor = model(Transitions(*context), asked, seen)
            return logits.double().softmax(dim=-1).cpu().numpy()
