"""The sections of a run file that do not depend on the problem."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Literal

from annotated_types import Ge, Gt, Interval, Le, Lt, MinLen

from icrl_dist.config.ranges import NotNegative, Positive, PositiveFloat, Probability, Rate, Rounds, Share
from icrl_dist.stream.schema import Remedy

Decoder = Literal["auto", "torch", "kernel"]
"""What computes decisions on a CPU: see ``ContextConfig``."""

Reproducible = Literal["auto", "any-machine", "this-machine"]
"""Where a fit gives the same weights digest: see ``LearnerConfig``."""

Deployment = Literal["paper", "committed", "growing"]
"""How T_theta is deployed online.

``paper``: Algorithm 1, the context is frozen within an episode.  ``growing``: every transition enters the
context immediately (Algorithm Distillation).  ``committed``: the same, and T_theta also reads the agent's
last actions as an action window (zeta of eq. 6).
"""

_NEVER = Remedy("must be from 0 to 1e9; 0 turns the alert off")
_AlertShare = Annotated[float, Interval(ge=0, le=1), Remedy("a share lies in [0, 1]; 0 turns the alert off")]


@dataclass(frozen=True)
class AdversaryConfig:
    """The adversaries of training tasks (appendix C.1)."""

    count: Annotated[int, Ge(0), Le(2**31 - 2), Remedy("0 or more disturbances, below 2^31 - 1")] = 8
    """K, disturbances per task; phi_0 is not one of them (appendix D.1 chooses 8)."""
    null: bool = True
    """Whether the task without disturbance, phi_0, is among the variations: a task then has K + 1 of them."""
    p_max: Probability = 0.2
    """Dark Room: an adversary disturbs a step with probability p ~ U(p_min, p_max)."""
    p_min: Probability = 0.0
    """Dark Room: 0 in the paper; with p_max, every disturbance has this strength."""

    @property
    def variations(self) -> int:
        """Variations per training task."""
        return self.count + self.null


@dataclass(frozen=True)
class PretrainConfig:
    """The pretraining dataset D_pre and the fit to it (sections 2 and 4.1)."""

    contexts: Positive = 80000
    """Total number of episodes, the same for every method and every K (appendix C.1).  A SAC expert's
    history contributes at most the episodes of its training."""
    behaviors: Annotated[tuple[str, ...], MinLen(1), Remedy("name at least one")] = ("random",)
    """Behavior policies that collect the contexts; successive episodes use them in turn.  Dark Room:
    ``random`` actions (as in the paper); ``persistent`` walks, which mostly repeat the last action; walks
    to random ``goals``, with a rest at each; a ``sweep`` through cells that were not visited yet."""
    queries: Positive = 16
    """Labelled query states per episode."""
    windows: NotNegative = 0
    """Action windows of ``model.window`` states per episode: in each the optimal policy acts, starting
    from a random state."""
    decoy_fraction: Share = 0.3
    """Share of the windows that are decoys: the optimal policy of another training task acts, and the labels
    are those of this task.  Decoys teach T_theta to drop a wrong hypothesis about the task."""
    steps: Positive = 20000
    """Optimizer steps."""


@dataclass(frozen=True)
class DAggerConfig:
    """DAgger rounds of DPT and ICAG: T^j collects histories, and the optimal policy labels them.

    Contexts of behavior policies differ from those at deployment, because no behavior policy explores
    as T_theta does.  Therefore in round j T^j is deployed in every training variation (Algorithm 1).
    """

    rounds: Rounds = 0
    """Number of rounds; the paper's ICAG has 0."""
    trials: Positive = 20
    """Episodes per history; a training context is a random number of its first episodes."""
    steps: Positive = 4000
    """Optimizer steps per round."""
    learning_rate: Rate = 1e-3
    """Peak learning rate of a round."""
    new_fraction: Share = 0.5
    """Share of the training batches whose contexts are histories; the other batches come from D_pre."""


@dataclass(frozen=True)
class ICAAConfig:
    """In-Context Adversarial Adaptation (Algorithm 3)."""

    rounds: Rounds = 3
    """J: there are J + 1 rounds j = 0..J of collecting and fine-tuning."""
    trials: Positive = 40
    """N: each variation is rolled out for N + 1 trials."""
    context_trials: NotNegative = 20
    """N_: the first N_ + 1 trials become contexts; labels come from later trials only."""
    label_trials: Literal["later", "top_return", "improved"] = "later"
    """Trials that labels come from.  ``later``: every later trial (Algorithm 3); ``top_return``: the half of
    them with the higher returns; ``improved``: those whose return exceeds the mean return of the context
    trials, so that a variation in which the agent did not improve gives no labels."""
    labels: Literal["actions", "returns", "transitions"] = "actions"
    """What labels are made of.  ``actions``: the agent's actions (Algorithm 3).  The other two compare actions by all N + 1
    trials of a variation, and label each state once with the nearly best ones: ``returns`` by the mean discounted
    return that followed, ``transitions`` by value iteration on the counted transitions.  They need discrete actions, states
    that recur, and rewards of at least 0."""
    label_gamma: Annotated[float, Gt(0), Lt(1), Remedy("a discount below 1")] = 0.9
    """Discount of these values."""
    label_slack: Share = 0.03
    """With ``returns`` and ``transitions`` an action is nearly best if its value is at most this share below the best."""
    explore: Share = 0.0
    """Probability of a random action in the trials after the context trials, so that they try actions that T^j does not
    take.  Contexts stay those of T^j.  0: T^j acts in all trials (Algorithm 3)."""
    context: Literal["trial", "history", "any"] = "history"
    """``history``: a context is trials 0 to n for a random n up to N_, as the deployed agent has it (Algorithm 1,
    line 16); ``trial``: a context is one of the trials 0 to N_ (Algorithm 3, lines 13 and 15); ``any``: 1 to N_ + 1 of all
    N + 1 trials in any order, so that a few variations give many contexts; not with ``labels = "actions"``, where the
    labels of a trial would belong to its own context."""
    steps: Positive = 4000
    """Fine-tuning steps per round."""
    learning_rate: Rate = 1e-3
    """Peak learning rate of fine-tuning."""
    new_fraction: Share = 0.5
    """Share of the fine-tuning batches that come from self-labelled data; the other batches come from D^0."""


@dataclass(frozen=True)
class ModelConfig:
    """The transformer T_theta (appendix B.2)."""

    layers: Positive = 4
    """Attention layers."""
    heads: Positive = 1
    """Attention heads per layer."""
    width: Positive = 32
    """Embedding size: 32 in Dark Room, 256 elsewhere."""
    fourier: NotNegative = 0
    """Sine and cosine pairs added to each observation component.  0: scaled values only, with which
    training and held-out goals have similar returns (docs/decisions/008-contexts-first.md)."""
    window: Annotated[int, Ge(1), Le(2**31 - 1), Remedy("at least 1 and below 2^31; 1 means no action windows")] = 1
    """States per action window.  T_theta also reads the actions and rewards of the window so far (zeta of
    eq. 6), so it can keep acting on one hypothesis.  1: no action windows, as in the paper's experiments."""
    dropout: Annotated[float, Ge(0), Lt(1), Remedy("a probability below 1")] = 0.0
    """Dropout on attention and feed-forward outputs."""


@dataclass(frozen=True)
class OptimConfig:
    """The optimizer (appendix B.2: AdamW, weight decay 1e-4, learning rate 1e-3, batch 128)."""

    learning_rate: Rate = 1e-3
    """Peak learning rate."""
    muon: Annotated[float, Ge(0), Le(1e6), Remedy("must be from 0 to 1e6")] = 0.0
    """Learning rate of Muon as a multiple of AdamW's, for the matrices of attention and feed-forward
    layers; AdamW trains the other parameters.  0: AdamW trains all, as in the paper."""
    weight_decay: Annotated[float, Ge(0), Le(1e6), Remedy("must be from 0 to 1e6")] = 1e-4
    """AdamW's decoupled weight decay."""
    beta2: Annotated[float, Ge(0), Lt(1), Remedy("must lie in [0, 1)")] = 0.999
    """AdamW's decay rate of the average of squared gradients; 0.98 suits short fits with high learning rates."""
    batch: Positive = 128
    """Contexts per step."""
    transitions: NotNegative = 0
    """Maximum number of transitions per step: a batch of long contexts has fewer contexts.  0: no limit."""
    queries: Positive = 32
    """(prefix, query) pairs per context; each pair has its own random prefix (the loss of eq. 1)."""
    windows: NotNegative = 0
    """Action windows per context (``model.window``), each with its own random prefix."""
    episodes: Positive = 4
    """Maximum number of episodes in a training context; each step draws the number at random."""
    warmup: NotNegative = 200
    """Steps of linear warm-up; then the learning rate falls to a tenth along a cosine."""
    clip: Annotated[float, Gt(0), Le(1e30), Remedy("must be above 0 and at most 1e30")] = 1.0
    """Maximum gradient norm; larger gradients are scaled down."""


@dataclass(frozen=True)
class ContextConfig:
    """The context D at deployment (Algorithm 1)."""

    max: Positive = 4000
    """Maximum number of transitions in a context; above it the oldest whole episodes are dropped."""
    keep: Literal["all", "last"] = "all"
    """``all``: keep every episode (Algorithm 1, line 16); ``last``: keep only the newest."""
    decoder: Decoder = "auto"
    """What computes decisions on a CPU: ``torch``, or ``kernel``, the compiled decoder, which is several times as fast and
    gives equal decisions on all processors.  ``auto``: the kernel if it was built, for models up to 128 wide.  A run keeps
    the one that it began with, because digests depend on it."""


@dataclass(frozen=True)
class EvaluateConfig:
    """Online evaluation on held-out tasks (section 5.1)."""

    episodes: Positive = 40
    """Online episodes per task."""
    p: Annotated[tuple[Probability, ...], MinLen(1), Remedy("name at least one override probability")] = (0.0, 0.2)
    """Probabilities p of a disturbed step to test; in continuous problems strengths of the adversary, as multiples of
    ``control.strength``."""
    prior: Literal["uniform", "unseen"] = "unseen"
    """Distribution of the test adversary's actions: ``uniform``, or drawn from a Dirichlet prior that no
    training adversary uses (``unseen``).  Winds and permuted controls of Dark Room are drawn alike in both."""
    seeds: Positive = 10
    """Independent evaluations of every task (the paper's 10 random seeds), each under a test adversary of its own; use
    at least 4, because how much a return depends on the adversary is seen in no other way."""


@dataclass(frozen=True)
class StreamConfig:
    """The streams between workers and learner."""

    endpoint: str = "tcp/127.0.0.1:0"
    """Address that the learner listens on; port 0 chooses a free port.  The default is loopback."""
    connect: str = ""
    """Address at which workers and monitors reach the learner, if it is not ``endpoint``, such as that of a
    proxy, a NAT or a port forward."""
    certificates: str = ""
    """Folder with ca.pem, and ROLE.pem and ROLE.key for each role of this node (learner, worker, monitor);
    required if the learner listens on an address that other nodes can reach."""
    job_tasks: Positive = 4
    """Tasks per job: their variations are stepped as one batch.  Larger batches are faster per step, smaller
    ones balance better over workers; the digests depend on it."""
    credits: Positive = 16
    """W: trajectories that a worker may have sent without a reply."""
    reply_timeout_s: PositiveFloat = 10.0
    """Seconds after which a trajectory without a reply is sent again."""
    lease_s: PositiveFloat = 60.0
    """Seconds that a job's next trajectory may take at most; the limit gets shorter after the first measurements."""
    max_message_bytes: Positive = 16 << 20
    """Maximum size of a message; a larger one is refused."""
    staleness: NotNegative = 0
    """Rounds that collecting may be ahead of the fits: jobs may use weights that are up to this many
    versions old (asynchronous mode).  Above 0, digests differ between runs."""


@dataclass(frozen=True)
class LearnerConfig:
    """The learner process."""

    threads: NotNegative = 0
    """CPU threads of a fit; 0 uses every core, because workers are idle during a fit.  With
    ``reproducible = "this-machine"`` the weights digest depends on it, so the run folder records it."""
    reproducible: Reproducible = "auto"
    """Where a repetition of the run has the same weights digest.  ``any-machine``: on every processor and with any number
    of threads; the compiled kernel fits, which is also faster than torch.  It needs a CPU, a model up to 128 wide without
    dropout, a method with DPT's model and loss, and ``context.decoder = "kernel"``.  ``this-machine``: on machines of one
    kind with the same threads; torch fits.  ``auto``: any-machine where it is possible.  A run keeps what it began with."""
    restarts: NotNegative = 3
    """Maximum number of restarts of the learner, and of successive restarts of a worker without progress;
    then the run fails."""
    cache_mb: NotNegative = 1024
    """Megabytes of the dataset that a fit keeps in memory; other trajectories are read when they are drawn."""
    device: Literal["auto", "cpu", "cuda"] = "auto"
    """Device of the fits; ``auto`` uses a GPU if there is one.  On a GPU torch fits."""
    prometheus: str = ""
    """HOST:PORT on which to serve the newest metrics for Prometheus, such as 127.0.0.1:9464; empty: off."""


@dataclass(frozen=True)
class AlertsConfig:
    """Thresholds of alerts, which appear in live views, in ``metrics.jsonl`` and on the monitor plane; 0 turns one off."""

    collapse: _AlertShare = 0.5
    """Alert if the mean return of the newest policy version is below this share of that of the previous
    version in the same trials of the same variations."""
    zero_episodes: Annotated[int, Ge(0), Le(10**9), _NEVER] = 40
    """Alert if this many successive episodes of a variation all returned 0."""
    silent_s: Annotated[float, Ge(0), Le(1e9), _NEVER] = 5.0
    """Alert if no heartbeat of a worker has arrived for this many seconds."""
    ingest: _AlertShare = 0.5
    """Alert if the workers could send during less than this share of the last ten seconds, because they
    waited for the learner for the rest."""
    labels: _AlertShare = 0.05
    """Alert if the share of self-made labels that are optimal falls by this much from one round to the next
    (ICAA, in problems with exact solutions)."""
