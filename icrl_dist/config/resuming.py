"""What makes a run the same run: the numbers of a run file that a resumed run may have changed, and all others."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import Any, NamedTuple

from icrl_dist.config.run import Run
from icrl_dist.config.sac import NOT_IN_TRAINING
from icrl_dist.config.sections import AlertsConfig, EvaluateConfig


def _fields(section: Any) -> frozenset[str]:
    return frozenset(item.name for item in dataclasses.fields(section))


FREE: Mapping[str, frozenset[str]] = {
    "alerts": _fields(AlertsConfig),
    "evaluate": _fields(EvaluateConfig),
    "learner": frozenset({"cache_mb", "device", "prometheus", "restarts"}),
    "sac": NOT_IN_TRAINING,
    "stream": frozenset({"certificates", "connect", "credits", "endpoint", "lease_s", "max_message_bytes", "reply_timeout_s"}),
}
"""The numbers, by section, on which neither the dataset nor the weights depend, so that a resume may change them.

They say where and how a run is executed, watched and evaluated.  ``learner.device`` is the machine's, as with ``auto``: where
torch fits, a resume on another device says that digests can differ.  Not free are ``learner.threads`` (unless
``learner.reproducible`` is any-machine) and ``stream.job_tasks``, because digests depend on them, and ``stream.staleness``,
which makes them depend on timing.  The engine, the number of workers and the address of a cluster are no numbers of a run.
"""

AUTO = ("context.decoder", "learner.reproducible")
"""The numbers that a resumed run keeps as it began with them if they are ``auto``."""


class Difference(NamedTuple):
    """A number that two runs have with different values."""

    name: str
    """As in ``pretrain.steps``."""
    before: Any
    after: Any


def differences(before: Run, after: Run) -> list[Difference]:
    """The numbers that decide a run's dataset and weights and that differ between two runs, where ``after`` resumes ``before``.

    Of runs with different problems the problem is named, but not the sections that only one of them has.
    """
    found = []
    for item in dataclasses.fields(before):
        old, new = getattr(before, item.name), getattr(after, item.name, None)
        if not dataclasses.is_dataclass(old):
            found += [Difference(item.name, old, new)] * (old != new)
        elif type(old) is type(new):
            names = _fields(type(old)) - FREE.get(item.name, frozenset())
            pairs = [(f"{item.name}.{name}", getattr(old, name), getattr(new, name)) for name in sorted(names)]
            kept = [name for name, _, value in pairs if name in AUTO and value == "auto"]
            if before.learner.reproducible == "any-machine":
                kept.append("learner.threads")
            found += [Difference(*pair) for pair in pairs if pair[1] != pair[2] and pair[0] not in kept]
    return found
