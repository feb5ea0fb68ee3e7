"""The model of a run and its optimizer: fits them phase by phase, and writes and reads their checkpoints."""

from __future__ import annotations

import threading
from collections.abc import Callable
from pathlib import Path

import torch

from icrl_dist.config.random_keys import RandomKey, generator
from icrl_dist.config.run import Run
from icrl_dist.interfaces import Draw, Method, Phase
from icrl_dist.storage import checkpoint
from icrl_dist.training import fit
from icrl_dist.types import Spec, Weights
from learner import checkpoints

SAVE_STEPS = 1000
"""Optimizer steps between checkpoints of a fit that is not finished."""


class Fitting:
    """Trains the newest policy version of a run; continues a fit that was interrupted."""

    def __init__(self, run: Run, folder: Path, method: Method, spec: Spec, device: torch.device, threads: int) -> None:
        """Builds an untrained model; ``resume`` loads the newest checkpoint of ``folder``.

        ``threads``: CPU threads of fits.
        """
        self._run, self._folder, self._spec, self._threads = run, folder, spec, threads
        self.device_name = torch.cuda.get_device_name(device) if device.type == "cuda" else device.type
        """``cpu``, or the name of the GPU."""
        self.method = method
        """The method whose loss a fit minimizes."""
        self._partial = folder / "checkpoints" / checkpoints.PARTIAL
        torch.manual_seed(run.seed)
        torch.set_deterministic_debug_mode("error")  # as use_deterministic_algorithms, which imports torch's compiler
        self._model = method.build(spec, run).to(device)
        self._optimizer = fit.Optimizer(self._model, run.optim)
        self._steps_done = 0
        self.version = checkpoint.newest_version(folder)
        """The newest policy version that was fitted; -1 before the first."""

    @property
    def steps_done(self) -> int:
        """Optimizer steps of the next version that are done."""
        return self._steps_done

    def resume(self) -> Weights | None:
        """Load the newest version, and the unfinished fit of the next one if there is one.

        Returns the weights of the newest version; None before the first.
        """
        newest = None
        if self.version >= 0:
            file = checkpoint.version_file(self._folder, self.version)
            checkpoints.restore(file, self._spec, self._model, self._optimizer)
            newest = self._weights()
        if self._partial.exists() and checkpoints.read_manifest(self._partial)["next_version"] == self.version + 1:
            self._steps_done = checkpoints.restore(self._partial, self._spec, self._model, self._optimizer)["step"]
        return newest

    def fit(
        self,
        phase: Phase,
        draw: Draw | None,
        report: Callable[[int, float], None],
        stop: threading.Event,
        check: Callable[[], None],
    ) -> float:
        """Train the next version from step ``_steps_done`` on; returns the mean loss of the last steps.

        ``draw``: draws the batches; None for a phase without steps.  ``report`` is called after each step with
        its number and its loss, then ``check``, which raises an error to end the fit.  A checkpoint is written
        before that if ``stop`` is set.
        """

        def loss_of(step: int) -> torch.Tensor:
            assert draw is not None
            rng = generator(self._run.seed, RandomKey.FIT, phase.next_version, step)
            torch.manual_seed(int(rng.integers(2**31)))
            return self.method.loss(self._model, draw(rng))

        def progress(step: int, loss: float) -> None:
            self._steps_done = step  # if damaged data ends this fit, the next call continues from here
            report(step, loss)
            if stop.is_set() or (step % SAVE_STEPS == 0 and step < phase.steps):
                self._save(self._partial, self._weights(), next_version=phase.next_version, step=step)
            check()

        torch_threads, first = torch.get_num_threads(), self._steps_done
        torch.set_num_threads(self._threads)
        try:
            args = self._model, self._optimizer, self._run.optim, phase.learning_rate, phase.steps
            loss = fit.fit(*args, loss_of, progress, first)
        finally:
            torch.set_num_threads(torch_threads)
        self._steps_done = 0
        self.version = phase.next_version
        return loss

    def save(self, **fields: object) -> Weights:
        """Write the checkpoint of the newest version, with these fields in its manifest; returns its weights."""
        weights = self._weights()
        self._save(checkpoint.version_file(self._folder, self.version), weights, **fields)
        self._partial.unlink(missing_ok=True)
        return weights

    def _weights(self) -> Weights:
        """The parameters of the model, hashed here and nowhere else in the learner."""
        return checkpoints.weights(self.version, self._model)

    def _save(self, path: Path, weights: Weights, **fields: object) -> None:
        manifest = checkpoints.manifest(self._run, self._spec, self.version, self._threads, self.device_name)
        checkpoints.save(path, weights, self._optimizer, {**manifest, **fields})
