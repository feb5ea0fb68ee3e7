"""Agents from checkpoints, run folders and the package."""

from __future__ import annotations

from collections.abc import Callable
from importlib import resources
from pathlib import Path
from typing import Any

from icrl_dist.agent.in_context_agent import InContextAgent
from icrl_dist.agent.ood_score import calibrate
from icrl_dist.agent.threads import whole_or_none
from icrl_dist.agent.trained_model import TrainedModel
from icrl_dist.config.paths import path_of
from icrl_dist.config.run import ConfigError, Deployment, load_folder, parse_written
from icrl_dist.config.sections import Decoder
from icrl_dist.methods import registry as methods
from icrl_dist.models.outcome_readout import OutcomeModel
from icrl_dist.storage.checkpoint import Checkpoint, load_checkpoint, newest_version, version_file
from icrl_dist.storage.files import StoreError
from icrl_dist.storage.fork import Lineage
from icrl_dist.storage.held import check_weights, hold
from icrl_dist.types import Spec

_AGENTS = Path(str(resources.files("icrl_dist.agent.shipped")))
SHIPPED = tuple(sorted(file.stem for file in _AGENTS.glob("*.npz")))
"""Names of the agents in the package; docs/results/engine.md describes the training of each."""


def load_agent(
    what: str | Path,
    seed: int | None = None,
    deploy: Deployment | None = None,
    threads: int | None = 1,
    decoder: Decoder = "auto",
) -> InContextAgent:
    """A trained agent, which acts without weight updates.

    ``what``: a run folder (its newest version), a checkpoint file, or the name of an agent of the package:
    ``load_agent("darkroom")`` loads that agent, ``"./darkroom"`` is a run folder of that name.
    ``seed``: of the draws of its actions; None: other draws each time.  ``deploy``: the deployment rule, ``paper``,
    ``committed`` or ``growing``; None: the rule that it was trained for.
    ``threads``: CPU threads of torch while the agent acts and observes; None: the number that torch is set to.  More
    than one helps large batches on idle cores.  On busy cores threads that wait for each other can take a hundred
    times as long (docs/decisions/073-openmp-wait-policy.md).  Outside these calls the process's own number holds.
    With one thread an agent also acts in a forked process; torch's threads do not survive a fork.
    ``decoder``: what computes its decisions, ``torch`` or ``kernel``, the compiled decoder, which always uses one thread
    and imports no torch.  ``auto``: the kernel if it was built, for models up to 128 wide, whatever the run used: their
    outputs agree to 1e-5.

    Raises ConfigError if there is no such agent, if it was not trained for the rule ``deploy``, if ``threads`` is
    below 1 or ``seed`` below 0, or if ``decoder`` is unknown or not built; StoreError if the file was not written by this
    system or its weights are no finite numbers.
    Loading executes no code from the file.
    """
    threads = whole_or_none("threads", threads, 1)
    checkpoint = agent_checkpoint(shipped(what)) if what in SHIPPED else open_checkpoint(path_of("what", what))
    manifest = {k: v for k, v in checkpoint.manifest.items() if k != "spec"}
    return InContextAgent(trained(checkpoint), manifest, seed, deploy, outcomes_of(checkpoint), threads, decoder)


def shipped(name: str | Path) -> Path:
    """The checkpoint file of an agent in the package.  Raises ConfigError for an unknown name."""
    if name not in SHIPPED:
        raise ConfigError(f"--pretrained {name}: no agent of that name in the package; there are {', '.join(SHIPPED)}")
    return _AGENTS / f"{name}.npz"


def slim(checkpoint: Checkpoint) -> Checkpoint:
    """The parts of a checkpoint that deployment needs: weights, outcome readout and manifest, without the dataset list."""
    manifest = {key: value for key, value in checkpoint.manifest.items() if key != "dataset"}
    return Checkpoint({k: v for k, v in checkpoint.arrays.items() if k.startswith(("model/", "outcomes/"))}, manifest)


def is_slim(path: Path) -> bool:
    """Whether a file holds only what ``slim`` keeps.  Such a file can be replaced: training does not need it."""
    try:
        checkpoint = load_checkpoint(path)
    except StoreError:
        return False
    slimmed = slim(checkpoint)
    return slimmed.arrays.keys() == checkpoint.arrays.keys() and slimmed.manifest.keys() == checkpoint.manifest.keys()


def calibrated(checkpoint: Checkpoint, progress: Callable[[int], None] = lambda episodes: None) -> Checkpoint:
    """The checkpoint with the outcome readout of its model (``ood_score.calibrate``).

    Returned unchanged if it has one, or if its method gives no states to ``watch``.
    """
    if checkpoint.part("outcomes"):
        return checkpoint
    found = trained(checkpoint)
    if not found.method.shows_states:
        return checkpoint
    outcomes = calibrate(found, progress).arrays()
    arrays = {**checkpoint.arrays, **{f"outcomes/{name}": value for name, value in outcomes.items()}}
    return Checkpoint(arrays, checkpoint.manifest)


def checkpoint_file(what: Path, version: int | None = None) -> Path:
    """The checkpoint file at this path, or of this version (None: newest) in a run folder.  Raises ConfigError if missing."""
    if not what.is_dir():
        if what.is_file():
            return what
        raise ConfigError(f"{what}: no such run folder or checkpoint; `icrl-dist train demo` makes one in runs/demo")
    found = version_file(what, newest_version(what) if version is None else version)
    if not found.is_file():
        raise ConfigError(f"{what}: holds no {'checkpoint' if version is None else f'version {version}'} yet")
    return found


def open_checkpoint(what: Path, version: int | None = None) -> Checkpoint:
    """The checkpoint at ``checkpoint_file(what, version)``; in a run folder it is held to its run.

    Raises ConfigError if it is missing, StoreError if it is damaged or of another run or version.
    """
    path = checkpoint_file(what, version)
    folder, number = path.absolute().parent.parent, path.stem.removeprefix("version-")
    checkpoint = agent_checkpoint(path)
    if path.absolute().parent.name == "checkpoints" and number.isdigit() and (folder / "run.toml").is_file():
        run = load_folder(folder)
        hold(checkpoint, path, int(number), Lineage.of(folder, run).run_of(int(number)))
    else:
        check_weights(checkpoint, path)
    return checkpoint


def agent_checkpoint(path: Path) -> Checkpoint:
    """Read the checkpoint of an agent.  Raises StoreError as ``load_checkpoint``, and for a file that holds no agent."""
    checkpoint = load_checkpoint(path)
    if missing := [name for name in ("run", "spec") if name not in checkpoint.manifest]:
        raise StoreError(
            f"{path}: holds no agent: its manifest has no {', '.join(missing)}; name a run folder or an agent file"
        )
    return checkpoint


def trained(checkpoint: Checkpoint) -> TrainedModel:
    """The model of a checkpoint, with the run that trained it.

    Raises StoreError if the arrays do not fit the model that the manifest describes.
    """
    try:
        run = parse_written(checkpoint.manifest["run"], "checkpoint")
        spec, method = spec_from(checkpoint.manifest["spec"]), methods.of(run)
        return TrainedModel.stored(run, method, spec, checkpoint.part("model"))
    except (KeyError, TypeError, ValueError, RuntimeError) as error:
        raise StoreError(f"checkpoint: not an agent of this version of icrl-dist ({' '.join(str(error).split())})") from None


def outcomes_of(checkpoint: Checkpoint) -> OutcomeModel | None:
    """The outcome readout of a checkpoint; None if it was not calibrated.

    Raises StoreError if the names of its arrays are wrong.
    """
    try:
        return OutcomeModel.of(checkpoint.part("outcomes"))
    except TypeError as error:
        raise StoreError(f"checkpoint: not calibrated by this version of icrl-dist ({error})") from None


def spec_from(fields: dict[str, Any]) -> Spec:
    """The spec from the fields that ``dataclasses.asdict`` gives, after JSON changed tuples to lists."""
    low, high = tuple(fields["low"]), tuple(fields["high"])
    return Spec(low, high, fields["actions"], fields["horizon"], fields["discrete"])
