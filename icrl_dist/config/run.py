"""Every number of a run, with the section of the paper it comes from.

A run file is TOML with one table a section below; ``load`` reads it strictly (an unknown
key, a wrong type or an impossible value is a ConfigError that names it) and the command
line overrides it.  Functions take the section they need, never the whole ``Run``, unless
they need many.
"""

from __future__ import annotations

import tomllib
import typing
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from importlib import resources
from pathlib import Path
from typing import Any, Literal

from icrl_dist.config.sac import PROBLEMS, ControlConfig, SACConfig
from icrl_dist.config.toml import ConfigError, build, dumps, nearest
from icrl_dist.config.validation import validate
from icrl_dist.problems.continuous import calibrated_strength
from icrl_dist.telemetry.alerts import AlertsConfig

__all__ = ["ConfigError", "Run", "dumps", "load", "override", "parse", "validate"]

Deployment = Literal["paper", "committed"]
"""How T_theta is deployed online: by Algorithm 1, its context frozen within an episode; or with every
transition in its context at once and its guesses kept (zeta of eq. 6)."""


@dataclass(frozen=True)
class DarkRoomConfig:
    """The room (appendix C.1)."""

    size: int = 10
    """Side of the square room, in cells."""
    horizon: int = 100
    """Steps an episode, H."""
    train_fraction: float = 0.8
    """Share of the goals that is trained on; the rest is only tested (80/20 goals)."""
    split_seed: int = 0
    """Seed of the shuffle that splits the goals."""
    gamma: float = 0.99
    """Discount of the optimal action values that labels come from."""
    label_slack: float = 0.1
    """A label is uniform over the actions whose value is within this of the best."""
    labels: Literal["soft", "sampled", "heuristic"] = "soft"
    """``soft``: see label_slack; ``sampled``: one action drawn from it (eq. 1 to the letter);
    ``heuristic``: the paper's "y first, then x" rule, optimal only without disturbance."""


@dataclass(frozen=True)
class AdversaryConfig:
    """The disturbances of pretraining (appendix C.1)."""

    count: int = 8
    """K, adversaries a task, phi_0 among them (appendix D.1 settles on 8)."""
    p_max: float = 0.2
    """An adversary overrides with probability p ~ U(0, p_max)."""


@dataclass(frozen=True)
class PretrainConfig:
    """The pretraining dataset D_pre and the fit to it (sections 2 and 4.1)."""

    contexts: int = 80000
    """Episodes in all, the same for every method and every K (appendix C.1); of a SAC expert's history
    no more than its training has."""
    behaviors: tuple[Literal["random", "persistent", "goals", "sweep"], ...] = ("random",)
    """Who walks through the contexts, by turns: ``random`` actions (the paper's); ``persistent``
    walks, which mostly go on as before; walks to random ``goals``, with a rest there; a ``sweep``
    through cells not yet visited."""
    queries: int = 16
    """Labelled query states an episode."""
    windows: int = 0
    """Windows of ``model.window`` states an episode, in which the optimal policy acts from a
    random state on."""
    decoy_fraction: float = 0.3
    """Share of the windows in which another training task's optimal policy acts, while labels are
    this task's: from them T_theta learns to let go of a guess that was wrong."""
    steps: int = 20000
    """Optimizer steps."""


@dataclass(frozen=True)
class DAggerConfig:
    """Further rounds of pretraining on histories that T_theta makes itself (DPT and ICAG; ICAA has its own).

    No behavior policy searches as a deployed T_theta does, so its own long contexts are foreign
    to it.  T^j is deployed in every training variation (Algorithm 1); the labels remain the
    optimal policy's, as in D_pre.
    """

    rounds: int = 0
    """Rounds; 0 is the paper's ICAG."""
    trials: int = 20
    """Episodes of a history; each round's contexts are its first few, up to all."""
    steps: int = 4000
    """Optimizer steps a round."""
    learning_rate: float = 1e-3
    """Peak learning rate of a round."""
    new_fraction: float = 0.5
    """Share of the batches that are histories; the rest come from D_pre."""


@dataclass(frozen=True)
class ICAAConfig:
    """In-Context Adversarial Adaptation (Algorithm 3)."""

    rounds: int = 3
    """J: rounds j = 0..J are collected and fine-tuned on, so J + 1 in all."""
    trials: int = 40
    """N: each variation is rolled out for N + 1 trials."""
    context_trials: int = 20
    """N_: the first N_ + 1 trials become contexts, labels come from strictly later ones."""
    label_trials: Literal["later", "top_return", "improved"] = "later"
    """``later``: every later trial (Algorithm 3); ``top_return``: the better half of them;
    ``improved``: those with a higher return than the context trials had on average, so that a
    variation in which nothing was learned gives no labels."""
    context: Literal["trial", "history"] = "history"
    """``history``: a context is trials 0 to n, what the deployed agent sees (Algorithm 1, line
    16); ``trial``: any of the trials, and with optim.episodes = 1 one of them (Algorithm 3,
    line 13)."""
    steps: int = 4000
    """Fine-tuning steps a round."""
    learning_rate: float = 1e-3
    """Peak learning rate of fine-tuning."""
    new_fraction: float = 0.5
    """Share of a fine-tuning batch that comes from self-labelled data; the rest from D^0."""


@dataclass(frozen=True)
class ModelConfig:
    """The transformer T_theta (appendix B.2)."""

    layers: int = 4
    """Attention layers."""
    heads: int = 1
    """Attention heads a layer."""
    width: int = 32
    """Embedding size: 32 in Dark Room, 256 elsewhere."""
    fourier: int = 0
    """Sine and cosine pairs added to each observation component; 0 gives the scaled values
    only, which keep no gap between training and held-out goals (docs/decisions.md)."""
    window: int = 1
    """States of a window: T_theta also reads what was done in the window so far (zeta of eq. 6), so
    that a guess once acted on is kept.  1: none, as in the paper's experiments."""
    dropout: float = 0.0
    """Dropout on attention and feed-forward outputs."""


def default_deployment(model: ModelConfig) -> Deployment:
    """``committed`` for a model that is trained on windows."""
    return "committed" if model.window > 1 else "paper"


@dataclass(frozen=True)
class OptimConfig:
    """The optimizer (appendix B.2: AdamW, weight decay 1e-4, learning rate 1e-3, batch 128)."""

    learning_rate: float = 1e-3
    """Peak learning rate."""
    muon: float = 0.0
    """Learning rate of Muon, over AdamW's, for the matrices of attention and feed-forward layers;
    the rest stays with AdamW.  0: AdamW for all, as in the paper."""
    weight_decay: float = 1e-4
    """AdamW's decoupled weight decay."""
    beta2: float = 0.999
    """AdamW's memory of squared gradients; shorter (0.98) suits short fits at high rates."""
    batch: int = 128
    """Contexts a step."""
    transitions: int = 0
    """Transitions a step, at most: of longer contexts fewer fit in; 0 for no limit."""
    queries: int = 32
    """(prefix, query) pairs a context; each sees its own random prefix (eq. 1, many times)."""
    windows: int = 0
    """Windows a context (``model.window``), each with its own random prefix."""
    episodes: int = 4
    """Episodes in a training context, at most; each step draws its own number."""
    warmup: int = 200
    """Steps of linear warm-up; then the rate falls to a tenth along a cosine."""
    clip: float = 1.0
    """Largest gradient norm."""


@dataclass(frozen=True)
class ContextConfig:
    """The context D at deployment (Algorithm 1)."""

    max: int = 4000
    """Transitions a context may hold; beyond it the oldest whole episodes are dropped."""
    keep: Literal["all", "last"] = "all"
    """``all``: every episode so far (Algorithm 1, line 16); ``last``: only the newest."""


@dataclass(frozen=True)
class EvaluateConfig:
    """Online evaluation on held-out tasks (section 5.1)."""

    episodes: int = 40
    """Online episodes a task."""
    p: tuple[float, ...] = (0.0, 0.2)
    """Override probabilities that are tested; in a continuous game, strengths of its adversary, of
    which 1 is ``control.strength``."""
    prior: Literal["uniform", "unseen"] = "unseen"
    """The test adversary's law: ``unseen`` Dirichlet priors, or ``uniform`` over the actions."""
    seeds: int = 10
    """Independent evaluations of every task (the paper's 10 random seeds)."""


@dataclass(frozen=True)
class StreamConfig:
    """The streams between workers and learner."""

    endpoint: str = "tcp/127.0.0.1:0"
    """Where the learner listens; port 0 takes a free one.  Loopback unless you change it."""
    connect: str = ""
    """Where workers and monitors reach the learner, if not where it listens: a proxy, a NAT, a
    port forward."""
    certificates: str = ""
    """Folder with ca.pem, and ROLE.pem and ROLE.key for each role that this machine plays
    (learner, worker, monitor); needed to listen anywhere but on this machine."""
    job_tasks: int = 4
    """Tasks a job: their variations are stepped as one batch.  Larger batches decide faster,
    smaller ones spread better over workers; the digests depend on it."""
    credits: int = 16
    """W: trajectories a worker may have unanswered."""
    reply_timeout_s: float = 10.0
    """A trajectory without a reply for so long is sent again."""
    lease_s: float = 60.0
    """The longest that a job's next trajectory may take; shorter once it has been measured."""
    max_message_bytes: int = 16 << 20
    """A larger message is refused."""
    staleness: int = 0
    """Rounds that collecting may run ahead of the fits: jobs may name weights up to so many
    versions old (asynchronous mode).  Above 0, digests differ from run to run."""


@dataclass(frozen=True)
class LearnerConfig:
    """The learner process."""

    threads: int = 0
    """Threads of a fit; 0 takes every core, for the workers wait meanwhile.  The weights
    digest depends on it, so it is recorded."""
    restarts: int = 3
    """Restarts of the learner, and of each worker in a row without progress, before the run
    gives up."""
    cache_mb: int = 1024
    """Megabytes of the dataset that a fit keeps in memory; the rest is read when it is drawn."""
    device: str = "auto"
    """``auto`` takes a GPU where there is one; ``cpu`` or ``cuda`` decide."""
    prometheus: str = ""
    """HOST:PORT to serve the newest metrics at, for Prometheus, such as 127.0.0.1:9464; empty: nowhere."""


@dataclass(frozen=True)
class Run:
    """One run: a method, a problem and every number."""

    method: Literal["dpt", "icag", "icaa", "experts"] = "icag"
    """Which method of section 4 pretrains the transformer; ``experts``: none does, only the SAC experts of
    a continuous game are made and kept, for later runs."""
    seed: int = 0
    """Every random draw of the run is keyed by this and by the identity of the work."""
    problem: str = "darkroom"
    """What it is about: ``darkroom``, ``metaworld-pick-place``, or one of DeepMind Control such as
    ``dmc-cheetah-run``."""
    darkroom: DarkRoomConfig = field(default_factory=DarkRoomConfig)
    control: ControlConfig = field(default_factory=ControlConfig)
    sac: SACConfig = field(default_factory=SACConfig)
    adversary: AdversaryConfig = field(default_factory=AdversaryConfig)
    pretrain: PretrainConfig = field(default_factory=PretrainConfig)
    dagger: DAggerConfig = field(default_factory=DAggerConfig)
    icaa: ICAAConfig = field(default_factory=ICAAConfig)
    model: ModelConfig = field(default_factory=ModelConfig)
    optim: OptimConfig = field(default_factory=OptimConfig)
    context: ContextConfig = field(default_factory=ContextConfig)
    evaluate: EvaluateConfig = field(default_factory=EvaluateConfig)
    stream: StreamConfig = field(default_factory=StreamConfig)
    learner: LearnerConfig = field(default_factory=LearnerConfig)
    alerts: AlertsConfig = field(default_factory=AlertsConfig)


def load(name_or_path: str) -> Run:
    """The run file of this name among the packaged ones, or at this path; ``experts-NAME``: its experts alone.

    Raises ConfigError if there is none, or if any key or value in it is impossible.
    """
    if name_or_path.startswith("experts-"):
        return replace(load(name_or_path.removeprefix("experts-")), method="experts")
    path = Path(name_or_path)
    packaged = resources.files("icrl_dist.config.runs")
    if path.suffix == ".toml" or "/" in name_or_path:
        if not path.is_file():
            raise ConfigError(f"run file {name_or_path!r}: no such file")
        try:
            text = path.read_text(encoding="utf-8")
        except (OSError, UnicodeDecodeError) as error:
            raise ConfigError(f"run file {name_or_path!r}: cannot be read: {error}") from None
    else:
        small = name_or_path.removesuffix("-laptop")
        if small.startswith("dmc-") and small in PROBLEMS:  # 11 problems share two files
            text = (packaged / f"dmc{name_or_path.removeprefix(small)}.toml").read_text(encoding="utf-8")
            return parse(f'problem = "{small}"\n{text}', name_or_path)
        file = packaged / f"{name_or_path}.toml"
        if not file.is_file() or name_or_path in ("dmc", "dmc-laptop"):
            names = packaged_runs()
            raise ConfigError(
                f"run {name_or_path!r}: no packaged run of that name{nearest(name_or_path, names)}; "
                f"there are {', '.join(names)}; a path must end in .toml"
            )
        text = file.read_text(encoding="utf-8")
    return parse(text, name_or_path)


def packaged_runs() -> list[str]:
    """The names that ``load`` knows."""
    files = resources.files("icrl_dist.config.runs").iterdir()
    alone = {file.name.removesuffix(".toml") for file in files if file.name.endswith(".toml")} - {"dmc", "dmc-laptop"}
    problems = [name for name in PROBLEMS if name.startswith("dmc-")]
    return sorted([*alone, *problems, *(f"{name}-laptop" for name in problems)])


def parse(text: str, source: str) -> Run:
    """The run that TOML ``text`` describes.  Raises ConfigError naming ``source`` and the key."""
    try:
        tables = tomllib.loads(text)
    except (ValueError, RecursionError) as error:  # also a number or a nesting beyond Python's limits
        raise ConfigError(f"{source}: not valid TOML: {error}") from None
    return _from_tables(tables, source)


def _from_tables(tables: dict[str, Any], source: str) -> Run:
    """The run that TOML tables describe.  Raises ConfigError naming ``source`` and the key."""
    run = typing.cast(Run, build(Run, tables, source))
    validate(run, source)
    try:
        return replace(run, control=calibrated_strength.resolved(run.control, run.problem))
    except ConfigError as error:
        raise ConfigError(f"{source}: {error}") from None


def override(run: Run, settings: Sequence[str], source: str) -> Run:
    """The run with ``settings`` such as ``adversary.count=16`` in place; text needs no quotes.

    Raises ConfigError for a setting that is none, or that the run cannot have.
    """
    tables = tomllib.loads(dumps(run))
    for setting in settings:
        name, equals, value = setting.partition("=")
        *path, key = name.strip().split(".")
        if not equals or len(path) > 1:
            raise ConfigError(f"{source} {setting}: write SECTION.NAME=VALUE, as in adversary.count=16")
        table = tables.setdefault(path[0], {}) if path else tables
        try:
            table[key] = tomllib.loads(f"value = {value}")["value"]
        except tomllib.TOMLDecodeError:
            table[key] = value.strip()
        except TypeError:
            raise ConfigError(f"{source} {setting}: {path[0]} is not a section") from None
    return _from_tables(tables, source)
