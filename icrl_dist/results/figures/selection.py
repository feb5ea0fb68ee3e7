"""Which arms a figure or a claim compares, and what is refused: missing rows, and arms that cannot be compared."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from icrl_dist.config.run import ConfigError
from icrl_dist.config.toml import nearest
from icrl_dist.results.figures.reading import BUDGETS, Arm, Key, Rows, named
from icrl_dist.results.names import AgentKey

EXACT = "exact"
"""The variant of a sweep whose rows are those of the reference agents."""
METHODS = ("dpt", "prompt_dt", "mix_dpt", "ardt", "ad", "dr", "icag", "icaa")
"""The methods of the paper and of this package, in the order of legends and tables."""
REFERENCES = ("exact:dpt", "exact:icag", "exact:paper", "oracle", "random")
"""Reference agents that figures show where there are rows of them."""
SAME = 0.1
"""Share by which budgets may differ, because episodes are divided among variations; figures name such differences."""
INFERRED = ("wind", "permuted")
"""Settings in which the disturbance itself must be inferred."""


class MissingError(ConfigError):
    """Rows are missing; the message lists the runs that make them.  ``runs``: SETTING/VARIANT, seeds."""

    def __init__(self, what: str, runs: Sequence[str]):
        self.runs = tuple(dict.fromkeys(runs))
        super().__init__(f"{what}: rows are missing; these runs make them: {'; '.join(self.runs)}")


@dataclass(frozen=True)
class Rules:
    """What may differ between arms that are compared; nothing by default."""

    common_seeds: bool = False
    """Compare only the training seeds that all of them have."""
    unequal_budgets: tuple[str, ...] = ()
    """Budgets, of ``BUDGETS``, that may differ between compared methods."""
    partial: bool = False
    """Show a figure without the arms whose rows are missing, and say which."""


@dataclass(frozen=True)
class Study:
    """The rows of one setting, with the rules of comparison."""

    rows: Rows
    setting: str
    rules: Rules = Rules()

    @property
    def keys(self) -> list[Key]:
        """The arms of the setting."""
        return [key for key in self.rows.keys if key.setting == self.setting]

    def variant(self, method: str, adversaries: int | None = None) -> str | None:
        """The variant that stands for a method (with K ``adversaries``): the one of its name, or else its only one.

        Raises ConfigError if there are several and none has the name.
        """
        found = [key for key in self.keys if key.method == method and key.variant != EXACT and AgentKey(key.agent).is_model]
        if adversaries is not None:
            found = [key for key in found if key.adversaries == adversaries]
        names = list(dict.fromkeys(key.variant for key in found))
        own = [name for name in (method, f"{method}-k{adversaries}") if name in names]
        if len(names) > 1 and not own:
            raise ConfigError(
                f"setting {self.setting!r}: {method} has the variants {', '.join(names)}; name one of them {method}"
            )
        return own[0] if own else names[0] if names else None

    def levels(self, variant: str, prior: str = "uniform", suite: str = "online") -> list[float]:
        """The strengths p at which models of a variant were evaluated under a prior; 0 under any prior."""
        here = [key for key in self.keys if key.variant == variant and key.suite == suite and AgentKey(key.agent).is_model]
        return sorted({key.p for key in here if key.p == 0 or key.prior == prior})

    def versions(self, variant: str) -> list[int]:
        """The policy versions of a variant that were evaluated online."""
        models = [key.agent for key in self.keys if key.variant == variant and key.suite == "online"]
        return sorted({int(agent[1:]) for agent in models if AgentKey(agent).is_model})

    def model(
        self,
        variant: str,
        p: float,
        *,
        prior: str = "uniform",
        suite: str = "online",
        data: str = "",
        version: int | None = None,
        rule: str = "paper",
    ) -> Arm | None:
        """A policy version of a variant, the newest by default, at one p; None if there are no rows.

        ``rule``: the deployment rule; of a variant that lacks it, its only rule if ``rule`` is ``paper``.
        """
        chosen = max(self.versions(variant), default=0) if version is None else version
        found = self._at(variant, f"t{chosen}", p, prior, suite, data)
        rules = list(dict.fromkeys(key.deployment for key in found))
        found = [key for key in found if key.deployment == rule or (rule == "paper" and len(rules) == 1)]
        return self.rows.arm(found[0]) if found else None

    def reference(
        self, agent: str, p: float, *, prior: str = "uniform", suite: str = "online", data: str = "", of: str | None = None
    ) -> Arm | None:
        """A reference agent at one p, of variant ``exact`` if it has rows, else of variant ``of`` or of the first that has."""
        variants = dict.fromkeys(key.variant for key in self.keys if key.agent == agent)
        order = [EXACT, *([of] if of else []), *variants]
        return next((self.rows.arm(k) for v in order for k in self._at(v, agent, p, prior, suite, data)), None)

    def _at(self, variant: str, agent: str, p: float, prior: str, suite: str, data: str) -> list[Key]:
        found = [
            key
            for key in self.keys
            if (key.variant, key.agent, key.suite, key.data) == (variant, agent, suite, data) and math.isclose(key.p, p)
        ]
        return [key for key in found if key.prior == prior] or (found if p == 0 else [])

    def seeds(self) -> str:
        """The training seeds of the setting, as messages list them."""
        found = sorted({part for key in self.keys for part in self.rows.seeds(key)})
        return listed(found) if found else "at least 5 of them"

    def run(self, variant: str) -> str:
        """The runs of a variant, as a message about missing rows lists them."""
        return f"{f'{self.setting}/' if self.setting else ''}{variant}, seeds {self.seeds()}"

    def comparable(self, arms: Sequence[Arm], what: str) -> list[Arm]:
        """The arms, with the training seeds that the rules allow.

        Raises ConfigError, with what differs, for arms of other training seeds, splits, evaluation settings, tasks or
        adversaries, and for methods of other budgets.
        """
        arms = self._common(arms, what)
        checks: list[tuple[str, Callable[[Arm], object], bool]] = [
            ("split seeds", lambda arm: tuple(part.split_seed for part in arm.parts), False),
            ("episodes of an evaluation", lambda arm: arm.returns.shape[3], False),
            ("evaluations of a task", lambda arm: arm.returns.shape[2], False),
            ("tasks", lambda arm: arm.returns.shape[1], False),
            ("held-out tasks", lambda arm: arm.tasks.tolist(), True),
        ]
        first = arms[0]
        for arm in arms[1:]:
            for name, of, hidden in checks:
                self._equal(what, name, first, arm, of, hidden)
            partner = next(a for a in arms if (a.key.p, a.key.prior, a.key.suite) == (arm.key.p, arm.key.prior, arm.key.suite))
            self._equal(what, "test adversaries", partner, arm, lambda arm: arm.adversaries.tolist(), True)
        self._check_budgets(arms, what)
        return arms

    def _common(self, arms: Sequence[Arm], what: str) -> list[Arm]:
        common = sorted(set.intersection(*(set(arm.seeds) for arm in arms)))
        if self.rules.common_seeds and common:
            return [arm.only(common) for arm in arms]
        for arm in arms:
            if arm.seeds != arms[0].seeds:
                raise ConfigError(
                    f"{what}: training seeds are {listed(arms[0].seeds)} of {_who(arms[0])} and {listed(arm.seeds)} of "
                    f"{_who(arm)}: train and evaluate the others, or compare {listed(common)} with --common-seeds"
                )
        return list(arms)

    def _equal(self, what: str, name: str, one: Arm, two: Arm, of: Callable[[Arm], object], hidden: bool) -> None:
        if of(one) != of(two):
            found = "differ between" if hidden else f"are {of(one)} of"
            other = "" if hidden else f"{of(two)} of "
            raise ConfigError(
                f"{what}: {name} {found} {_who(one)} and {other}{_who(two)}: evaluate both alike (`icrl-dist sweep`)"
            )

    def _check_budgets(self, arms: Sequence[Arm], what: str) -> None:
        models = [arm for arm in arms if AgentKey(arm.key.agent).is_model]
        for column, one, two in unequal(models, SAME):
            if column in self.rules.unequal_budgets:
                continue
            raise ConfigError(
                f"{what}: {column} is {of_budget(one, column):.12g} of {_who(one)} and {of_budget(two, column):.12g} of "
                f"{_who(two)}: train both with equal budgets, or compare them anyway with --unequal-budgets {column}"
            )


def unequal(models: Sequence[Arm], share: float = 0.0) -> list[tuple[str, Arm, Arm]]:
    """Budgets that differ between methods by more than this share: the column, and the arms with the least and the most.

    A budget that is not known of an arm is compared with nothing.
    """
    found = []
    for column in BUDGETS:
        known = [(budget, arm) for arm in models if (budget := of_budget(arm, column)) is not None]
        if not known:
            continue
        (least, one), (most, two) = (choose(known, key=lambda of: of[0]) for choose in (min, max))
        if least < (1 - share) * most:
            found.append((column, one, two))
    return found


def of_budget(arm: Arm, column: str) -> float | None:
    """Mean of a budget over the trainings of an arm; None if it is not known of all."""
    values = [getattr(part, column) for part in arm.parts]
    return None if None in values else float(np.mean(values))


def _who(arm: Arm) -> str:
    at = f" at p = {arm.key.p:g}" + (f" ({arm.key.prior})" if arm.key.p else "")
    return f"{named(arm.key)} {arm.key.agent}{at}"


def listed(seeds: Sequence[int]) -> str:
    """Seeds in words: ``0 to 9`` or ``0, 2, 5``."""
    if len(seeds) > 2 and seeds[-1] - seeds[0] == len(seeds) - 1:
        return f"{seeds[0]} to {seeds[-1]}"
    return ", ".join(map(str, seeds)) or "none"


def study(rows: Rows, setting: str | None, rules: Rules) -> Study:
    """The study of a setting; None: of the only one in which the disturbance need not be inferred.

    Raises ConfigError for an unknown setting, with the nearest name, for several, and for one with several problems.
    """
    known = list(dict.fromkeys(key.setting for key in rows.keys))
    plain = [name for name in known if not is_inferred(name)] or known
    if setting is None and len(plain) > 1:
        raise ConfigError(f"report: the rows have the settings {', '.join(plain)}; choose one with --setting")
    chosen = plain[0] if setting is None else setting
    if chosen not in known:
        names = ", ".join(repr(name) for name in known)
        raise ConfigError(f"--setting {chosen}: no rows of this setting{nearest(chosen, known)}; there are {names}")
    problems = dict.fromkeys(key.problem for key in rows.keys if key.setting == chosen)
    if len(problems) > 1:
        raise ConfigError(f"setting {chosen!r}: the rows are of the problems {', '.join(problems)}; give rows of one")
    return Study(rows, chosen, rules)


def is_inferred(setting: str) -> bool:
    """Whether the disturbance must be inferred in a setting: ``wind``, ``permuted``, or a name that ends so."""
    return any(setting == name or setting.endswith(f"-{name}") for name in INFERRED)
