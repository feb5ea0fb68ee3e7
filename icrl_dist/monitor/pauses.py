"""Times of a replay: without the pauses in which the run did not run."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from datetime import datetime
from pathlib import Path

from icrl_dist.telemetry import provenance
from icrl_dist.telemetry.metric_rows import Row

PAUSE_S = 1.0
"""What a pause between two sessions lasts in a replay."""
CLOCK_S = 60.0
"""A row that is older than its predecessor by more than this shows that the clock was set back."""
MAX_GAP_S = 600.0
"""What a longer time without any row lasts in a replay: the machine was suspended, or its clock was set."""


def session_starts(folder: Path) -> list[float]:
    """When each session of a run began, in Unix seconds."""
    starts = []
    for session in provenance.sessions(folder):
        try:
            starts.append(datetime.fromisoformat(str(session["began"])).timestamp())
        except (KeyError, ValueError):
            continue
    return starts


def without_pauses(rows: Sequence[Row], starts: Iterable[float]) -> list[Row]:
    """The rows in the order in which they were written, with times that never decrease and hold no pause.

    The first row keeps its time.  ``starts``: the starts of the sessions; the time between the last row before a start
    and the first row from it on becomes at most ``PAUSE_S``.
    """
    answer, starts = list[Row](), sorted(starts)
    before = now = rows[0]["time"] if rows else 0.0
    for row in rows:
        if row["time"] < before - CLOCK_S:
            before = row["time"]
        paused = any(before < start <= row["time"] for start in starts)
        now += min(max(0.0, row["time"] - before), PAUSE_S if paused else MAX_GAP_S)
        before = max(before, row["time"])  # an event is written a moment after its time
        answer.append({**row, "time": now})
    return answer
