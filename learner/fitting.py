"""The model of a run and its optimizer: fits them phase by phase, and writes and reads their checkpoints."""

from __future__ import annotations

import math
import threading
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import torch

from icrl_dist.config.random_keys import RandomKey, generator
from icrl_dist.config.run import ConfigError, Run
from icrl_dist.config.sections import LearnerConfig
from icrl_dist.interfaces import Draw, Method, Phase
from icrl_dist.models.dpt import PretrainedTransformer
from icrl_dist.models.weights import share_weights, weights_of
from icrl_dist.storage import checkpoint
from icrl_dist.storage.checkpoint import partial_file
from icrl_dist.training import fit, kernel_fit
from icrl_dist.training.kernel_fit import KernelFit
from icrl_dist.types import Spec, Weights
from learner import checkpoints
from learner.recovery import continues, starts_again

SAVE_STEPS = 1000
"""Optimizer steps between checkpoints of a fit that is not finished."""
EXPLODED = 10.0
"""A fit has diverged if its last mean loss is more than this many times its first loss, or than 1 if that is more."""


class RunFailed(RuntimeError):  # noqa: N818
    """The run cannot continue; the message is one line for the user."""


def device_of(config: LearnerConfig) -> torch.device:
    """The device of ``learner.device``: ``auto`` is the CPU for fits through the kernel, which runs there.

    Raises RunFailed if it is ``cuda`` and torch finds no GPU.
    """
    name = "cpu" if config.reproducible == "any-machine" else config.device
    if name == "cuda" and not torch.cuda.is_available():
        raise RunFailed("learner.device = 'cuda': torch finds no GPU; use auto or cpu")
    return torch.device("cuda" if name != "cpu" and torch.cuda.is_available() else "cpu")


class Fitting:
    """Trains the newest policy version of a run; continues a fit that was interrupted."""

    def __init__(
        self,
        run: Run,
        folder: Path,
        method: Method,
        spec: Spec,
        device: torch.device,
        threads: int,
        intact: Mapping[int, Mapping[str, Any]],
        note: Callable[[str], None],
    ) -> None:
        """Builds an untrained model; ``load`` loads the newest checkpoint of ``folder``.

        ``threads``: CPU threads of fits; ``intact``: the manifests of the versions whose checkpoints can be used;
        ``note`` gets a line about an unfinished fit that cannot be continued.
        """
        self._run, self._folder, self._spec, self._threads = run, folder, spec, threads
        self._intact = intact
        self.note = note
        """Called with what cannot be used."""
        self.device_name = torch.cuda.get_device_name(device) if device.type == "cuda" else device.type
        """``cpu``, or the name of the GPU."""
        self.method = method
        """The method whose loss a fit minimizes."""
        self._partial = partial_file(folder)
        torch.manual_seed(run.seed)
        torch.set_deterministic_debug_mode("error")  # as use_deterministic_algorithms, which imports torch's compiler
        self._model = method.build(spec, run).to(device)
        self._kernel = self._kernel_fit() if run.learner.reproducible == "any-machine" else None
        self._optimizer = self._kernel or fit.Optimizer(self._model, run.optim)
        self._steps_done = 0
        self._first_loss = math.nan
        self.version = -1
        """The newest policy version that was fitted or loaded; -1 before the first."""

    def _kernel_fit(self) -> KernelFit:
        """The fit through the compiled kernel; from now on the model's parameters are views of its weights."""
        assert isinstance(self._model, PretrainedTransformer), "another model is not fitted by the kernel"
        self._model.draw_weights(generator(self._run.seed, RandomKey.INITIAL_WEIGHTS))
        found = KernelFit(self._spec, self._run.model, self._run.optim, weights_of(self._model), self._threads)
        share_weights(self._model, found.weights)
        self._model.eval()
        return found

    @property
    def steps_done(self) -> int:
        """Optimizer steps of the next version that are done."""
        return self._steps_done

    def load(self) -> Weights | None:
        """Load the newest version that follows the present one without a gap, and the unfinished fit of the next one.

        Returns the weights of the version that was loaded; None if there is none.
        """
        newest, loaded = self.version, None
        while newest + 1 in self._intact:
            newest += 1
        if newest > self.version:
            file = checkpoint.version_file(self._folder, newest)
            checkpoints.restore(file, self._spec, self._model, self._optimizer)
            self.version = newest
            loaded = Weights(newest, weights_of(self._model), str(self._intact[newest]["weights_digest"]))
        steps = {phase.next_version: phase.steps for phase in self.method.phases(self._run)}.get(self.version + 1, 0)
        if continues(self._partial, self._run, self.version, steps, self.note):
            try:
                manifest = checkpoints.restore(self._partial, self._spec, self._model, self._optimizer)
            except ConfigError as error:
                self.note(starts_again(error, self.version))
            else:
                self._steps_done, self._first_loss = manifest["step"], float(manifest.get("first_loss", math.nan))
        return loaded

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
        before that if ``stop`` is set.  Raises FloatingPointError for a fit that diverged: a loss or a parameter is not
        finite, or the loss has become ``EXPLODED`` times as large as at the first step (or as 1, if that is more).
        """

        def batch_of(step: int) -> Any:
            assert draw is not None
            rng = generator(self._run.seed, RandomKey.FIT, phase.next_version, step)
            torch.manual_seed(int(rng.integers(2**31)))  # for dropout
            return draw(rng)

        def progress(step: int, loss: float) -> None:
            self._steps_done = step  # if damaged data ends this fit, the next call continues from here
            if step == 1:
                self._first_loss = loss
            report(step, loss)
            if stop.is_set() or (step % SAVE_STEPS == 0 and step < phase.steps):
                about = {"next_version": phase.next_version, "step": step, "first_loss": self._first_loss}
                self._save(self._partial, self._weights(), **about)
            check()

        loss = self._take_steps(phase, batch_of, progress)
        self._steps_done = 0
        remedy = f"lower the learning rate ({phase.learning_rate:g})"
        if phase.steps and loss > EXPLODED * max(1.0, self._first_loss):
            raise FloatingPointError(f"the loss rose from {self._first_loss:g} to {loss:g}: {remedy}")
        if not all(bool(parameter.isfinite().all()) for parameter in self._model.parameters()):
            raise FloatingPointError(f"a parameter is infinite or not a number after the last step: {remedy}")
        self.version = phase.next_version
        return loss

    def _take_steps(self, phase: Phase, batch_of: Callable[[int], Any], progress: Callable[[int, float], None]) -> float:
        """Take the remaining steps of a phase; returns the mean loss of the last ones."""
        config, peak, steps, first = self._run.optim, phase.learning_rate, phase.steps, self._steps_done
        if (kernel := self._kernel) is not None:
            take = lambda step, rate: kernel.step(batch_of(step), rate)  # noqa: E731
            return fit.take_steps(take, config, peak, steps, progress, first, kernel_fit.cosine)
        assert isinstance(self._optimizer, fit.Optimizer)
        loss_of = lambda step: self.method.loss(self._model, batch_of(step))  # noqa: E731
        threads = torch.get_num_threads()
        torch.set_num_threads(self._threads)
        try:
            return fit.fit(self._model, self._optimizer, config, peak, steps, loss_of, progress, first)
        finally:
            torch.set_num_threads(threads)

    def save(self, accept: Callable[[Weights], None], **fields: object) -> Weights:
        """Write the checkpoint of the newest version, with these fields in its manifest; returns its weights.

        ``accept`` is called with them before anything is written; it raises an error if they cannot be used.
        """
        weights = self._weights()
        accept(weights)
        self._save(checkpoint.version_file(self._folder, self.version), weights, **fields)
        self._partial.unlink(missing_ok=True)
        return weights

    def _weights(self) -> Weights:
        """The parameters of the model, hashed here and nowhere else in the learner."""
        return checkpoints.weights(self.version, self._model)

    def _save(self, path: Path, weights: Weights, **fields: object) -> None:
        manifest = checkpoints.manifest(self._run, self._spec, self.version, self._threads, self.device_name)
        checkpoints.save(path, weights, self._optimizer, {**manifest, **fields})
