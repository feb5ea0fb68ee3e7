"""What a run that begins or continues here takes where its settings say ``auto``: its decoder, and its way to fit."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

from icrl_dist.config.resuming import differences
from icrl_dist.config.run import Run, load_folder
from icrl_dist.models.kernel import best_decoder, missing_kernel, require_kernel
from icrl_dist.training.reproducible import best_fit, require_kernel_fit


def without_auto(run: Run, folder: Path, resume: bool, note: Callable[[str], None] = lambda text: None) -> Run:
    """The run with its decoder and its way to fit named, where they were ``auto``: the best here, or those of the run there.

    ``note`` gets a line if a run begins with torch because the compiled decoder cannot be used here.
    Raises ConfigError for a kernel where this installation has none, and for a fit that is impossible here; not for a run
    with other settings than the one there, because ``train.prepare`` refuses it and names them.
    """
    before = load_folder(folder) if resume and (folder / "run.toml").is_file() else None
    there, changed = before or run, before is not None and differences(before, run)
    decoder, fits, missing = run.context.decoder, run.learner.reproducible, ""
    decoder = there.context.decoder if decoder == "auto" else decoder
    if decoder == "auto":
        decoder, missing = best_decoder(run.model), missing_kernel(run.model)
    run = replace(run, context=replace(run.context, decoder=decoder))
    fits = there.learner.reproducible if fits == "auto" else fits
    fits = best_fit(run) if fits == "auto" else fits
    run = replace(run, learner=replace(run.learner, reproducible=fits))
    if changed:
        return run
    if decoder == "kernel":
        require_kernel()
    require_kernel_fit(run)
    if missing:
        slower = "which is slower, and its digests are equal only on machines of one kind"
        note(f"compiled decoder: {missing}. This run uses torch, {slower}")
    return run
