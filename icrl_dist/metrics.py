"""Numbers of a run: ``metrics.jsonl`` is the truth, TensorBoard a view of it."""

from __future__ import annotations

import json
import time
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from torch.utils.tensorboard.writer import SummaryWriter


class Metrics:
    """Appends rows to ``folder/metrics.jsonl`` and, if asked, TensorBoard events beside it."""

    def __init__(self, folder: Path, tensorboard: bool = True) -> None:
        self._file = (folder / "metrics.jsonl").open("a", buffering=1)
        self._board: SummaryWriter | None = None
        if tensorboard:
            from torch.utils.tensorboard.writer import SummaryWriter

            self._board = SummaryWriter(str(folder / "tensorboard"), flush_secs=10)

    def write(self, step: int, stage: str, **values: float) -> None:
        """One row: ``step`` counts within ``stage`` (a name such as ``fit/1``)."""
        self._file.write(json.dumps({"time": round(time.time(), 3), "stage": stage, "step": step, **values}) + "\n")
        if self._board is not None:
            for name, value in values.items():
                self._board.add_scalar(f"{stage}/{name}", value, step)

    def close(self) -> None:
        self._file.close()
        if self._board is not None:
            self._board.close()
