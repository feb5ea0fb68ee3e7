"""ARDT (appendix B.1): prompt-DT with the returns-to-go that the worst adversary leaves, by minimax expectile regression."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated

from annotated_types import Gt, Lt

from icrl_dist.config.ranges import Positive, Rate, Share
from icrl_dist.config.run import Run
from icrl_dist.interfaces import TrajectoryDataset
from icrl_dist.methods.prompt_dt import PromptDT, cached
from icrl_dist.problems import registry
from icrl_dist.stream.schema import Remedy
from icrl_dist.types import Task, Trajectory, Variation

if TYPE_CHECKING:
    from icrl_dist.training.sequences import Histories


@dataclass(frozen=True)
class ARDTConfig:
    """The return nets of ARDT; the transformer has the settings of ``[prompt_dt]``."""

    alpha: Annotated[float, Gt(0), Lt(1), Remedy("must lie between 0 and 1")] = 0.01
    """Expectile over the adversary's actions; that over the agent's is 1 - alpha.  0.5 gives means in place of extremes."""
    leaf_weight: Share = 0.9
    """Weight of the last step in the loss of Q(s, a, adversary's action); the recursion has the rest."""
    steps: Positive = 2000
    """Optimizer steps of the return nets, before those of the transformer (``pretrain.steps``)."""
    batch: Positive = 32
    """Episodes per step of the return nets."""
    width: Positive = 64
    """Width of their two hidden layers."""
    learning_rate: Rate = 1e-3
    """Learning rate of Adam."""


class ARDT(PromptDT):
    """Prompt-DT on ICAG's contexts, because it needs logged actions of adversaries; its target is relabelled too.

    A window holds relabelled returns-to-go, a prompt observed ones: the return nets know the training tasks only.
    """

    name = "ardt"
    section = "ardt"
    Config = ARDTConfig

    def objections(self, run: Run) -> Iterator[tuple[str, object, str]]:
        yield from super().objections(run)
        if run.adversary.count == 0:
            yield "adversary.count", 0, "ardt learns from the actions of adversaries: use at least 1, or the method prompt_dt"

    def training_variations(self, run: Run, index: int, task: Task, round: int) -> tuple[Variation, ...]:
        """The K variations of ICAG."""
        return registry.training_variations(run, index, task, round)

    def extra_steps(self, run: Run) -> int:
        """Those of the return nets."""
        return int(run.section("ardt").steps)

    def _histories(self, run: Run, dataset: TrajectoryDataset) -> Sequence[Histories]:
        """Fits the return nets, whose draws depend on the seed of the run only, so a resumed run has the same ones."""
        from icrl_dist.training.return_nets import ReturnNets, Settings
        from icrl_dist.training.sequences import Histories

        config, problem = run.section("ardt"), registry.of(run)
        settings = Settings(**{of.name: getattr(config, of.name) for of in dataclasses.fields(config)})
        nets = ReturnNets(problem.spec, run.model.fourier, settings, problem.train_count, run.seed)
        observed = super()._histories(run, dataset)
        nets.fit(observed, [task for _, _, task, _ in dataset.variations("pretrain", 0)])

        def relabel(run: Run, trials: Sequence[Trajectory]) -> Histories:
            history = Histories.read(trials)
            return dataclasses.replace(history, to_go=nets.relabelled(trials[0].identity.task, history))

        return cached(run, dataset, relabel)
