"""The table of budgets: what each variant of a setting was trained with, and whether the methods had the same."""

from __future__ import annotations

from collections.abc import Sequence

from icrl_dist.results.claims import costs
from icrl_dist.results.figures.reading import BUDGETS, Arm
from icrl_dist.results.figures.selection import EXACT, METHODS, MissingError, Study, listed, of_budget, unequal
from icrl_dist.results.markup import CERTIFIED, Sheet, number
from icrl_dist.results.names import AgentKey

TITLE = "Budgets"
COLUMNS = ("training_episodes", *BUDGETS)
CERTIFIED_P = 0.2


def sheet(study: Study) -> Sheet:
    """One row for each variant with a model: its budgets (means over training seeds), and certified return at p = 0.2."""
    arms = newest(study)
    if not arms:
        raise MissingError("figure budgets", [study.run(method) for method in METHODS])
    rows = tuple(_row(study, arm) for arm in arms)
    different = [f"{column} ({one.key.variant}, {two.key.variant})" for column, one, two in unequal(arms)]
    if len(arms) == 1:
        verdict = "A single variant: nothing is compared"
    else:
        verdict = f"Budgets differ: {'; '.join(different)}" if different else f"Equal for all variants: {', '.join(BUDGETS)}"
    unknown = [column for column in BUDGETS if any(of_budget(arm, column) is None for arm in arms)]
    verdict += f". Not known of all: {', '.join(unknown)}" if unknown else ""
    verdict += _return_nets(study, arms)
    caption = f"{verdict}. Means over training seeds. {CERTIFIED}; here p = 0.2"
    title = TITLE + (f", setting {study.setting}" if study.setting else "")
    names = ("variant", "method", "K", "seeds", *(name.replace("_", " ") for name in COLUMNS), "labels", "certified")
    return Sheet(title, names, rows, caption)


def _return_nets(study: Study, arms: Sequence[Arm]) -> str:
    """What the caption adds about ARDT, whose return nets take optimizer steps that no column counts."""
    text = ""
    known = costs.ledger(study.rows.files)
    for arm in arms:
        if arm.key.method == "ardt":
            entries = (known.get((study.setting, arm.key.variant, seed), {}) for seed in arm.seeds)
            steps = sorted({one["budget"]["extra_steps"] for one in entries if "extra_steps" in one.get("budget", {})})
            counts = " to ".join(f"{n:,}" for n in dict.fromkeys([*steps[:1], *steps[-1:]])) or "ardt.steps"
            text += (
                f". Not counted: the return nets of {arm.key.variant} take {counts} smaller steps beside its optimizer steps"
            )
    return text


def newest(study: Study) -> list[Arm]:
    """The newest model of each variant, at its smallest p."""
    found = []
    variants = dict.fromkeys(key.variant for key in study.keys if AgentKey(key.agent).is_model and key.variant != EXACT)
    for variant in variants:
        levels = study.levels(variant)
        arm = study.model(variant, levels[0]) if levels else None
        found += [arm] if arm else []
    return sorted(found, key=lambda arm: METHODS.index(arm.key.method) if arm.key.method in METHODS else len(METHODS))


def _row(study: Study, arm: Arm) -> tuple[str, ...]:
    key, budgets = arm.key, [of_budget(arm, column) for column in COLUMNS]
    sources = ", ".join(dict.fromkeys(part.label_source or "-" for part in arm.parts))
    disturbed = study.model(key.variant, CERTIFIED_P)
    certified = "-" if disturbed is None else number(disturbed.worst())
    known = ["-" if value is None else f"{value:,.0f}" for value in budgets]
    return (key.variant, key.method, str(key.adversaries), listed(arm.seeds), *known, sources, certified)
