"""Every method by each of its deployment rules, such as ``committed`` beside Algorithm 1."""

from __future__ import annotations

from icrl_dist.results.figures import panels
from icrl_dist.results.figures.choices import Choice, Spot, entries, references
from icrl_dist.results.figures.panels import Panel
from icrl_dist.results.figures.selection import METHODS, MissingError, Study
from icrl_dist.results.figures.styles import label_of
from icrl_dist.results.names import AgentKey
from icrl_dist.results.returns import LAST

TITLE = "Deployment rules: committed beside Algorithm 1"
_RULES = {"committed": "committed", "paper": "Algorithm 1"}


def numbers(study: Study, letter: str = "") -> list[Panel]:
    """Bars in groups by p: each method by each of its rules, and the exact agents by both.

    One panel for the last episodes, and one for all, in which rules that learn within an episode are ahead.
    """
    choices = []
    for method in METHODS:
        variant = study.variant(method)
        models = [
            key for key in study.keys if key.variant == variant and key.suite == "online" and AgentKey(key.agent).is_model
        ]
        rules = list(dict.fromkeys(key.deployment for key in models))
        choices += [
            Choice(method, variant, f"{label_of(method)}, {_RULES.get(rule, rule)}", rule=rule)
            for rule in sorted(rules, reverse=True)
        ]
    if not any(choice.rule == "committed" for choice in choices):
        raise MissingError("figure deployment", [f"{study.run('icag')}, evaluated with --deploy committed"])
    levels = sorted(set.intersection(*(set(study.levels(c.variant)) for c in choices if c.variant)))
    shown_levels = [p for p in levels if p in (0.0, 0.2, 0.4, 0.6)] or levels
    exact = references(("exact:dpt", "exact:dpt-committed", "exact:icag", "exact:icag-committed", "exact:paper", "oracle"))
    spots = [Spot(p, group=f"p = {p:g}") for p in shown_levels]
    shown, note = entries(study, "figure deployment", [*choices, *exact], spots)
    arms = [arm for entry in shown for arm in entry.arms]
    episodes = arms[0].returns.shape[3]
    found: list[Panel] = []
    for suffix, last, text in (
        ("", min(LAST, episodes), f"last {min(LAST, episodes)}"),
        (" (all)", episodes, f"all {episodes}"),
    ):
        title, caption = f"{text} episodes", panels.resampled(arms, last)
        panel = Panel(f"deployment{suffix}", title, "bars", "", "return", panels.bars(shown, last), caption)
        found.append(panels.with_note(panel, note))
    return found
