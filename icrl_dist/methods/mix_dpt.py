"""Mix-DPT (Wang et al., 2024): DPT that goes on learning from a mixture of D^0 and its own labelled histories."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Annotated, ClassVar

from annotated_types import Ge, Gt, Le, Lt

from icrl_dist.config.ranges import Positive, Rate, Share, remedy
from icrl_dist.config.run import Run
from icrl_dist.interfaces import Phase
from icrl_dist.methods.dpt import DPT, OwnHistories, pretrain_phase
from icrl_dist.problems import registry
from icrl_dist.stream.schema import Remedy
from icrl_dist.types import Job


@dataclass(frozen=True)
class MixDPTConfig:
    """Mix-DPT: an early phase on D^0 only, then rounds in which T^j collects histories and D^0 is mixed in.

    Episodes and optimizer steps are DPT's: ``pretrain.contexts`` and ``pretrain.steps`` are those of the whole training.
    D^0 holds the episodes that the rounds leave.
    """

    rounds: Annotated[int, Ge(1), Le(9000), Remedy("must be from 1 to 9000")] = 3
    """Rounds after the early phase."""
    trials: Positive = 12
    """Episodes per history; each round collects one history of every training task."""
    kappa: Share = 1 / 3
    """Share of the training batches of a round that come from D^0; the other contexts are histories (Wang et al.: 1/3)."""
    early: Annotated[float, Gt(0), Lt(1), Remedy("must lie between 0 and 1, so that no phase is without steps")] = 0.4
    """Share of the optimizer steps in the early phase (appendix B.1: 40%); the rounds divide the others evenly."""
    learning_rate: Rate = 1e-3
    """Peak learning rate of a round.  Tune it together with ``optim.learning_rate``: the default was not tuned.  In
    darkroom-7x7 (split seed 100, one training seed each) the return at p = 0 was 20.7 with 1e-3, 22.6 with 3e-3 and 20.9
    with 6e-3."""


class MixDPT(DPT):
    """DPT whose own histories, labelled by the optimal policy, become training data; tasks without disturbance."""

    name = "mix_dpt"
    section: ClassVar[str] = "mix_dpt"
    Config: ClassVar[type] = MixDPTConfig

    def objections(self, run: Run) -> Iterator[tuple[str, object, str]]:
        of: MixDPTConfig = run.section(self.section)
        problem = registry.of(run)
        if problem.labeller is None:
            yield "method", run.method, f"{run.problem} cannot label new histories, which mix_dpt needs: use dpt or icag"
            return
        if run.dagger.rounds:
            yield "dagger.rounds", run.dagger.rounds, "mix_dpt has rounds of its own (mix_dpt.rounds): use dagger.rounds = 0"
        tasks, least = problem.train_count, of.rounds * of.trials + 1
        if run.pretrain.contexts // tasks < least:
            why = f"{of.rounds} rounds of {of.trials} episodes in {tasks} tasks leave none for D^0; or lower mix_dpt.trials"
            yield "pretrain.contexts", run.pretrain.contexts, remedy(tasks * least, None, why)
        if min(steps_of_phases(run)) < 1:
            yield (
                "pretrain.steps",
                run.pretrain.steps,
                "too few for the early phase and every round: raise it, or lower mix_dpt.rounds",
            )

    def phases(self, run: Run) -> tuple[Phase, ...]:
        """The early phase, then the rounds; together they have ``pretrain.steps`` steps."""
        early, *steps = steps_of_phases(run)
        rate = run.section(self.section).learning_rate
        rounds = (Phase("adapt", j, count, rate) for j, count in enumerate(steps))
        return (dataclasses.replace(pretrain_phase(run), steps=early), *rounds)

    def ask(self, run: Run, phase: Phase) -> tuple[Job, ...]:
        """Jobs of D^0, whose episodes are those that the rounds leave, or jobs of labelled histories of T^j."""
        if phase.stage != "pretrain":
            return super().ask(run, phase)
        of: MixDPTConfig = run.section(self.section)
        contexts = run.pretrain.contexts - of.rounds * of.trials * registry.of(run).train_count
        return super().ask(dataclasses.replace(run, pretrain=dataclasses.replace(run.pretrain, contexts=contexts)), phase)

    def histories(self, run: Run) -> OwnHistories:
        of: MixDPTConfig = run.section(self.section)
        return OwnHistories(of.trials, 1 - of.kappa)


def steps_of_phases(run: Run) -> list[int]:
    """Optimizer steps of the early phase and of each round; the first rounds take what an even division leaves."""
    of: MixDPTConfig = run.section(MixDPT.section)
    early = round(of.early * run.pretrain.steps)
    each, left = divmod(run.pretrain.steps - early, of.rounds)
    return [early, *(each + (j < left) for j in range(of.rounds))]
