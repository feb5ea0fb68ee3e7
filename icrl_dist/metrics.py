"""Numbers of a run: ``metrics.jsonl`` is the truth, TensorBoard a view of it."""

from __future__ import annotations

import contextlib
import json
import time
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

from icrl_dist.files import unwritten

if TYPE_CHECKING:
    from torch.utils.tensorboard.writer import SummaryWriter


class Metrics:
    """Appends rows to ``folder/metrics.jsonl`` and, if asked, TensorBoard events beside it.

    Every method raises StoreError if they cannot be written.
    """

    def __init__(self, folder: Path, tensorboard: bool = True) -> None:
        self._rows, self._events = folder / "metrics.jsonl", folder / "tensorboard"
        with _writing(self._rows):
            self._file = self._rows.open("a", buffering=1)
        self._board: SummaryWriter | None = None
        if tensorboard:
            from torch.utils.tensorboard.writer import SummaryWriter

            with _writing(self._events):
                self._board = SummaryWriter(str(self._events), flush_secs=10)

    def write(self, step: int, stage: str, **values: float) -> None:
        """One row: ``step`` counts within ``stage`` (a name such as ``fit/1``)."""
        with _writing(self._rows):
            self._file.write(json.dumps({"time": round(time.time(), 3), "stage": stage, "step": step, **values}) + "\n")
        if self._board is not None:
            with _writing(self._events):
                for name, value in values.items():
                    self._board.add_scalar(f"{stage}/{name}", value, step)

    def close(self) -> None:
        with _writing(self._rows):
            self._file.close()
        if self._board is not None:
            with _writing(self._events):
                self._board.close()


@contextlib.contextmanager
def _writing(path: Path) -> Iterator[None]:
    try:
        yield
    except OSError as error:
        raise unwritten(path, error) from error
