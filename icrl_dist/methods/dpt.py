"""DPT (section 2): tasks without disturbance, labels from each task's optimal policy."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from jaxtyping import Float32, Float64, Int64

from icrl_dist.config.run import Run
from icrl_dist.config.sections import ContextConfig, Deployment, ModelConfig
from icrl_dist.interfaces import Draw, Method, Phase, TrajectoryDataset, Watch
from icrl_dist.methods import jobs
from icrl_dist.types import Job, Spec, Task, Variation

if TYPE_CHECKING:
    import torch

    from icrl_dist.models.dpt import PretrainedTransformer
    from icrl_dist.models.stored import StoredTransformer
    from icrl_dist.rollout.deployment import InContextPolicy
    from icrl_dist.training.batches import TrainingBatch


def pretrain_phase(run: Run) -> Phase:
    """The fit to D_pre."""
    return Phase("pretrain", 0, run.pretrain.steps, run.optim.learning_rate)


def no_dagger(run: Run) -> Iterator[tuple[str, object, str]]:
    """The objection of a method without DAgger rounds."""
    if run.dagger.rounds:
        yield "dagger.rounds", run.dagger.rounds, f"{run.method} has no such rounds: use 0"


class OwnHistories(NamedTuple):
    """The labelled histories of T^j in the rounds after pretraining."""

    trials: int
    """Episodes per history."""
    share: float
    """Share of a round's training batches whose contexts are histories; the other batches come from D_pre."""


class DPT(Method):
    """Decision-pretrained transformer; the base of ICAG and ICAA, which share its model, loss and policy."""

    name = "dpt"
    shows_states = True

    @property
    def fits_by_kernel(self) -> bool:
        """False for a method of another package that changes the model or the loss."""
        return type(self).build is DPT.build and type(self).loss is DPT.loss

    def training_variations(self, run: Run, index: int, task: Task, round: int) -> tuple[Variation, ...]:
        """Only the task under the null adversary."""
        return (Variation(task),)

    def phases(self, run: Run) -> tuple[Phase, ...]:
        """The fit to D_pre, then the DAgger rounds (an extension of the paper; none by default)."""
        dagger = run.dagger
        rounds = (Phase("adapt", j, dagger.steps, dagger.learning_rate) for j in range(dagger.rounds))
        return (pretrain_phase(run), *rounds)

    def ask(self, run: Run, phase: Phase) -> tuple[Job, ...]:
        """Jobs of contexts and labels in every variation; in a DAgger round jobs of labelled histories of T^j.

        Two of three DAgger jobs deploy a model with action windows by Algorithm 1, because those histories
        differ most from D_pre.
        """
        choose = functools.partial(self._choose, run)
        if phase.stage == "pretrain":
            return jobs.pretraining_contexts(run, phase, choose)
        rules: tuple[Deployment, ...] = ("paper", "committed", "paper") if run.model.window > 1 else ("paper",)
        return jobs.labelled_rollouts(run, phase, choose, rules, self.histories(run).trials)

    def histories(self, run: Run) -> OwnHistories:
        """The histories that the rounds after pretraining collect."""
        return OwnHistories(run.dagger.trials, run.dagger.new_fraction)

    def _choose(self, run: Run, index: int, task: Task) -> tuple[Variation, ...]:
        return self.training_variations(run, index, task, 0)

    def data(self, run: Run, phase: Phase, dataset: TrajectoryDataset) -> Draw:
        """Draws from D_pre; in a DAgger round also from the histories of this round and all earlier ones."""
        from icrl_dist.methods import examples
        from icrl_dist.training.batches import CachedExamples, Pool

        cache = examples.cache(run, dataset, examples.labelled)
        pretrain = Pool(1.0, CachedExamples(cache, dataset.variations("pretrain", 0)), run.optim.episodes)
        if phase.stage == "pretrain":
            return examples.draw(run, [pretrain])
        histories = [key for j in range(phase.round + 1) for key in dataset.variations("adapt", j)]
        trials, share = self.histories(run)
        own = Pool(share, CachedExamples(cache, histories), trials)
        return examples.draw(run, [dataclasses.replace(pretrain, share=1 - share), own])

    def build(self, spec: Spec, run: Run) -> PretrainedTransformer:
        from icrl_dist.models.dpt import PretrainedTransformer

        return PretrainedTransformer(spec, run.model)

    def stored_model(self, spec: Spec, run: Run, weights: Mapping[str, np.ndarray]) -> StoredTransformer | None:
        """None for a method of another package that changes the model or the policy: its code expects the torch model."""
        from icrl_dist.models.stored import StoredTransformer

        same = type(self).build is DPT.build and type(self).policy is DPT.policy
        return StoredTransformer.of(spec, run.model, weights) if same else None

    def loss(self, model: PretrainedTransformer, batch: TrainingBatch) -> torch.Tensor:
        """The loss of eq. (1); with action windows also that of eq. (6)."""
        from icrl_dist.methods.dpt_loss import batch_loss

        return batch_loss(model, batch)

    def deployment(self, run: Run) -> Deployment:
        return self.rule(run.model)

    def rule(self, model: ModelConfig) -> Deployment:
        """The deployment rule of models with these settings."""
        from icrl_dist.rollout.deployment import default_deployment

        return default_deployment(model)

    def policy(
        self,
        model: PretrainedTransformer | StoredTransformer,
        batch: int,
        context: ContextConfig,
        deploy: Deployment | None = None,
        watch: Watch | None = None,
    ) -> InContextPolicy:
        from icrl_dist.rollout.deployment import in_context

        return in_context(model, batch, context, self.rule(model.config) if deploy is None else deploy, watch)

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
            *context, states, lengths = (torch.from_numpy(a).to(model.low.device) for a in (*transitions, queries, prefix))
            logits: torch.Tensor = model(Transitions(*context), states, lengths)
            return logits.double().softmax(dim=-1).cpu().numpy()
