"""Prompt-DT (appendix B.1): a decision transformer of returns-to-go, prompted by a piece of another episode of the task."""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar, cast

from icrl_dist.config.ranges import Positive, Share, remedy
from icrl_dist.config.run import Run
from icrl_dist.config.sections import ContextConfig, Deployment
from icrl_dist.interfaces import Draw, Method, Phase, TrajectoryDataset, UsedLabels, Watch
from icrl_dist.methods import jobs
from icrl_dist.methods.dpt import no_dagger, pretrain_phase
from icrl_dist.problems import registry
from icrl_dist.types import Job, Spec, Task, Trajectory, Variation

if TYPE_CHECKING:
    import torch

    from icrl_dist.models.dt import DecisionTransformer
    from icrl_dist.models.segments import PromptBatch
    from icrl_dist.rollout.prompted import PromptedPolicy
    from icrl_dist.training.sequences import Histories


@dataclass(frozen=True)
class PromptDTConfig:
    """The inputs of prompt-DT and ARDT."""

    window: Positive = 20
    """Steps of the window, the present one included (K of appendix B.1)."""
    prompt: Positive = 5
    """Consecutive steps of another episode in a prompt (K* of appendix B.1, which gives no number)."""
    prompt_dropout: Share = 0.1
    """Share of the training windows without a prompt: a deployed agent has none in its first episode."""
    windows: Positive = 2
    """Windows drawn from each of the ``optim.batch`` variations of a step.  With 2 windows of 20 steps a step learns from
    at most 40 actions a variation, where DPT's learns from ``optim.queries`` labels a context."""


class PromptDT(Method):
    """Trained on the actions of DPT's contexts, without labels, and deployed with the largest return of these as target.

    It repeats the actions in its data.  Dark Room's contexts are walks of behavior policies that do not know the goal (the
    paper's are random), so there it learns to repeat these walks, except where returns-to-go are informative.
    """

    name = "prompt_dt"
    section = "prompt_dt"
    Config: ClassVar[type | None] = PromptDTConfig

    def objections(self, run: Run) -> Iterator[tuple[str, object, str]]:
        yield from no_dagger(run)
        if run.pretrain.windows:  # the worker would collect them, and nothing would read them
            advice = f"{run.method} reads no action windows: use 0, and optim.windows = 0 and model.window = 1"
            yield "pretrain.windows", run.pretrain.windows, advice
        horizon, config = registry.of(run).horizon, run.section("prompt_dt")
        for key in ("window", "prompt"):
            if (value := getattr(config, key)) > horizon:
                yield f"prompt_dt.{key}", value, remedy(1, horizon, f"at most the horizon, {horizon} steps")

    def training_variations(self, run: Run, index: int, task: Task, round: int) -> tuple[Variation, ...]:
        """Only the task under the null adversary, as DPT."""
        return (Variation(task),)

    def phases(self, run: Run) -> tuple[Phase, ...]:
        """One fit, to D_pre."""
        return (pretrain_phase(run),)

    def ask(self, run: Run, phase: Phase) -> tuple[Job, ...]:
        return jobs.pretraining_contexts(run, phase, lambda index, task: self.training_variations(run, index, task, 0))

    def used_labels(self, run: Run, phase: Phase, job: Job) -> UsedLabels:
        """The actions of every episode take the place of labels."""
        return UsedLabels("logged actions", job.trials)

    def data(self, run: Run, phase: Phase, dataset: TrajectoryDataset) -> Draw:
        """Draws windows with prompts (``training.sequences.draw``); reads all of D_pre once for target and scale."""
        from icrl_dist.training import sequences

        config, histories = run.section("prompt_dt"), self._histories(run, dataset)
        target = max(float(one.to_go[:, 0].max()) for one in histories)
        scale = max(1e-6, *(float(abs(values).max()) for one in histories for values in (one.to_go, one.observed)))
        how = sequences.Drawn(run.optim.batch, config.windows, config.window, config.prompt, config.prompt_dropout)
        return functools.partial(sequences.draw, histories=histories, how=how, target=target, scale=scale)

    def _histories(self, run: Run, dataset: TrajectoryDataset) -> Sequence[Histories]:
        """The episodes of every variation of D_pre, with the returns-to-go that windows hold."""
        from icrl_dist.training.sequences import Histories

        return cached(run, dataset, lambda run, trials: Histories.read(trials))

    def build(self, spec: Spec, run: Run) -> DecisionTransformer:
        from icrl_dist.models.dt import DecisionTransformer

        config = run.section("prompt_dt")
        return DecisionTransformer(spec, run.model, config.window, config.prompt)

    def loss(self, model: DecisionTransformer, batch: PromptBatch) -> torch.Tensor:
        """Cross-entropy of the actions in a window, or of vectors the squared error."""
        return model.loss(batch)

    def policy(
        self,
        model: DecisionTransformer,
        batch: int,
        context: ContextConfig,
        deploy: Deployment | None = None,
        watch: Watch | None = None,
    ) -> PromptedPolicy:
        """``watch`` is not called."""
        from icrl_dist.rollout.prompted import prompted

        return prompted(model, batch, context, deploy)


def cached(run: Run, dataset: TrajectoryDataset, make: Callable[[Run, Sequence[Trajectory]], Histories]) -> Sequence[Histories]:
    """The histories of every variation of D_pre, made by ``make(run, trials)`` and kept up to ``learner.cache_mb``."""
    from icrl_dist.methods import examples
    from icrl_dist.training.batches import CachedExamples

    found = examples.cache(run, dataset, make)
    return cast("Sequence[Histories]", CachedExamples(found, dataset.variations("pretrain", 0)))
