"""Sections of a run file that every problem and every method share, with ranges beside the fields."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Literal

from annotated_types import Ge, Interval, Lt, MinLen

from icrl_dist.config.ranges import NotNegative, NotNegativeFloat, Positive, PositiveFloat, Probability, Share
from icrl_dist.stream.schema import Remedy

Deployment = Literal["paper", "committed"]
"""How T_theta is deployed online.

``paper``: Algorithm 1, the context is frozen within an episode.  ``committed``: every transition joins
the context at once, and the agent reads its own recent actions as an action window (zeta of eq. 6).
"""

_NEVER = Remedy("must not be negative; 0 is never")
_AlertShare = Annotated[float, Interval(ge=0, le=1), Remedy("a share lies in [0, 1]; 0 is never")]


@dataclass(frozen=True)
class AdversaryConfig:
    """The disturbances of pretraining (appendix C.1)."""

    count: Annotated[int, Ge(1), Remedy("at least 1, the null adversary")] = 8
    """K, adversaries a task, phi_0 among them (appendix D.1 settles on 8)."""
    p_max: Probability = 0.2
    """An adversary overrides with probability p ~ U(0, p_max)."""


@dataclass(frozen=True)
class PretrainConfig:
    """The pretraining dataset D_pre and the fit to it (sections 2 and 4.1)."""

    contexts: Positive = 80000
    """Episodes in all, the same for every method and every K (appendix C.1); of a SAC expert's history
    no more than its training has."""
    behaviors: Annotated[tuple[str, ...], MinLen(1), Remedy("name at least one")] = ("random",)
    """Behavior policies that collect the contexts, in turn from episode to episode.  Dark Room:
    ``random`` actions (the paper's); ``persistent`` walks, which mostly repeat the last action; walks
    to random ``goals``, with a rest there; a ``sweep`` through cells not visited yet."""
    queries: Positive = 16
    """Labelled query states an episode."""
    windows: NotNegative = 0
    """Windows of ``model.window`` states an episode, in which the optimal policy acts from a
    random state on."""
    decoy_fraction: Share = 0.3
    """Share of the windows that are decoys: another training task's optimal policy acts, while labels are
    this task's.  From them T_theta learns to give up a wrong guess of the task."""
    steps: Positive = 20000
    """Optimizer steps."""


@dataclass(frozen=True)
class DAggerConfig:
    """DAgger rounds of DPT and ICAG: T^j collects histories, the optimal policy labels them.

    No behavior policy explores as a deployed T_theta does, so contexts of behavior policies differ
    from those at deployment.  In round j T^j is deployed in every training variation (Algorithm 1).
    """

    rounds: NotNegative = 0
    """Rounds; 0 is the paper's ICAG."""
    trials: Positive = 20
    """Episodes of a history; each round's contexts are its first few, up to all."""
    steps: Positive = 4000
    """Optimizer steps a round."""
    learning_rate: PositiveFloat = 1e-3
    """Peak learning rate of a round."""
    new_fraction: Share = 0.5
    """Share of the batches that are histories; the rest come from D_pre."""


@dataclass(frozen=True)
class ICAAConfig:
    """In-Context Adversarial Adaptation (Algorithm 3)."""

    rounds: NotNegative = 3
    """J: rounds j = 0..J are collected and fine-tuned on, so J + 1 in all."""
    trials: Positive = 40
    """N: each variation is rolled out for N + 1 trials."""
    context_trials: NotNegative = 20
    """N_: the first N_ + 1 trials become contexts, labels come from strictly later ones."""
    label_trials: Literal["later", "top_return", "improved"] = "later"
    """``later``: every later trial (Algorithm 3); ``top_return``: the better half of them;
    ``improved``: those with a higher return than the context trials had on average, so that a
    variation in which nothing was learned gives no labels."""
    context: Literal["trial", "history"] = "history"
    """``history``: a context is trials 0 to n, what the deployed agent sees (Algorithm 1, line
    16); ``trial``: any of the trials, and with optim.episodes = 1 one of them (Algorithm 3,
    line 13)."""
    steps: Positive = 4000
    """Fine-tuning steps a round."""
    learning_rate: PositiveFloat = 1e-3
    """Peak learning rate of fine-tuning."""
    new_fraction: Share = 0.5
    """Share of a fine-tuning batch that comes from self-labelled data; the rest from D^0."""


@dataclass(frozen=True)
class ModelConfig:
    """The transformer T_theta (appendix B.2)."""

    layers: Positive = 4
    """Attention layers."""
    heads: Positive = 1
    """Attention heads a layer."""
    width: Positive = 32
    """Embedding size: 32 in Dark Room, 256 elsewhere."""
    fourier: NotNegative = 0
    """Sine and cosine pairs added to each observation component; 0 gives the scaled values
    only, which keep no gap between training and held-out goals (docs/decisions/008-contexts-first.md)."""
    window: Annotated[int, Ge(1), Remedy("at least 1, which is none")] = 1
    """States of a window: T_theta also reads what was done in the window so far (zeta of eq. 6), so
    that a guess once acted on is kept.  1: none, as in the paper's experiments."""
    dropout: Annotated[float, Ge(0), Lt(1), Remedy("a probability below 1")] = 0.0
    """Dropout on attention and feed-forward outputs."""


@dataclass(frozen=True)
class OptimConfig:
    """The optimizer (appendix B.2: AdamW, weight decay 1e-4, learning rate 1e-3, batch 128)."""

    learning_rate: PositiveFloat = 1e-3
    """Peak learning rate."""
    muon: NotNegativeFloat = 0.0
    """Learning rate of Muon, over AdamW's, for the matrices of attention and feed-forward layers;
    the rest stays with AdamW.  0: AdamW for all, as in the paper."""
    weight_decay: NotNegativeFloat = 1e-4
    """AdamW's decoupled weight decay."""
    beta2: Annotated[float, Ge(0), Lt(1), Remedy("must lie in [0, 1)")] = 0.999
    """AdamW's memory of squared gradients; shorter (0.98) suits short fits at high rates."""
    batch: Positive = 128
    """Contexts a step."""
    transitions: NotNegative = 0
    """Transitions a step, at most: of longer contexts fewer fit in; 0 for no limit."""
    queries: Positive = 32
    """(prefix, query) pairs a context; each sees its own random prefix (eq. 1, many times)."""
    windows: NotNegative = 0
    """Windows a context (``model.window``), each with its own random prefix."""
    episodes: Positive = 4
    """Episodes in a training context, at most; each step draws its own number."""
    warmup: NotNegative = 200
    """Steps of linear warm-up; then the rate falls to a tenth along a cosine."""
    clip: PositiveFloat = 1.0
    """Largest gradient norm."""


@dataclass(frozen=True)
class ContextConfig:
    """The context D at deployment (Algorithm 1)."""

    max: Positive = 4000
    """Transitions a context may hold; beyond it the oldest whole episodes are dropped."""
    keep: Literal["all", "last"] = "all"
    """``all``: every episode so far (Algorithm 1, line 16); ``last``: only the newest."""


@dataclass(frozen=True)
class EvaluateConfig:
    """Online evaluation on held-out tasks (section 5.1)."""

    episodes: Positive = 40
    """Online episodes a task."""
    p: Annotated[tuple[Probability, ...], MinLen(1), Remedy("name at least one override probability")] = (0.0, 0.2)
    """Override probabilities that are tested; in a continuous game, strengths of its adversary, of
    which 1 is ``control.strength``."""
    prior: Literal["uniform", "unseen"] = "unseen"
    """The test adversary's law: ``unseen`` Dirichlet priors, or ``uniform`` over the actions."""
    seeds: Positive = 10
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
    job_tasks: Positive = 4
    """Tasks a job: their variations are stepped as one batch.  Larger batches decide faster,
    smaller ones spread better over workers; the digests depend on it."""
    credits: Positive = 16
    """W: trajectories a worker may have unanswered."""
    reply_timeout_s: PositiveFloat = 10.0
    """A trajectory without a reply for so long is sent again."""
    lease_s: PositiveFloat = 60.0
    """The longest that a job's next trajectory may take; shorter once it has been measured."""
    max_message_bytes: Positive = 16 << 20
    """A larger message is refused."""
    staleness: NotNegative = 0
    """Rounds that collecting may run ahead of the fits: jobs may name weights up to so many
    versions old (asynchronous mode).  Above 0, digests differ from run to run."""


@dataclass(frozen=True)
class LearnerConfig:
    """The learner process."""

    threads: NotNegative = 0
    """Threads of a fit; 0 takes every core, for the workers wait meanwhile.  The weights
    digest depends on it, so it is recorded."""
    restarts: NotNegative = 3
    """Restarts of the learner, and of each worker in a row without progress, before the run
    gives up."""
    cache_mb: NotNegative = 1024
    """Megabytes of the dataset that a fit keeps in memory; the rest is read when it is drawn."""
    device: Literal["auto", "cpu", "cuda"] = "auto"
    """``auto`` takes a GPU where there is one; ``cpu`` or ``cuda`` decide."""
    prometheus: str = ""
    """HOST:PORT to serve the newest metrics at, for Prometheus, such as 127.0.0.1:9464; empty: nowhere."""


@dataclass(frozen=True)
class AlertsConfig:
    """Thresholds of alerts, which appear in live views, in ``metrics.jsonl`` and on the monitor plane.  0: never."""

    collapse: _AlertShare = 0.5
    """The newest version returns less than this share of what the one before returned in the same
    trials of the same variations."""
    zero_episodes: Annotated[int, Ge(0), _NEVER] = 40
    """The last so many episodes of a variation all returned 0."""
    silent_s: Annotated[float, Ge(0), _NEVER] = 5.0
    """No heartbeat of a worker has arrived for so long, seconds."""
    ingest: _AlertShare = 0.5
    """The learner stores less than this share of what the workers could send: during the rest of the last
    ten seconds the workers waited for the learner."""
    labels: _AlertShare = 0.05
    """From one round to the next, the share of self-made labels that are optimal falls by this much
    (ICAA, in problems with exact answers)."""
