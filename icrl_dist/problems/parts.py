"""Optional parts of a problem with interfaces of their own: ``posterior``, ``game``, ``certify`` and ``second_player``."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np
from jaxtyping import Float, Float32, Float64

from icrl_dist.interfaces import MakePolicy
from icrl_dist.types import Spec, Step, Task, Variation

if TYPE_CHECKING:
    from icrl_dist.agent.in_context_agent import InContextAgent
    from icrl_dist.config.run import Run

Decide = Callable[..., Float64[np.ndarray, "B N A"]]
"""``decide(transitions, queries, prefix)``: the model's distributions, as ``Method.distributions`` gives them."""


class PosteriorSuite(Protocol):
    """``Problem.posterior``: compares a model with the exact posterior (``icrl-dist evaluate --suite posterior``).

    The calls are those of ``results/heldout.py``, which also needs ``Problem.exact``.
    """

    @property
    def kinds(self) -> Sequence[str]:
        """The kinds of contexts."""
        ...

    @property
    def priors(self) -> Mapping[str, str]:
        """The two priors that the figure shows: the meaning of each for titles, by its key, ``""`` and ``"_any"``."""
        ...

    def levels(self, run: Run) -> Sequence[float]:
        """The adversaries' strengths p in the contexts."""
        ...

    def divergences(self, run: Run, decide: Decide, act: MakePolicy, heldout: bool) -> Iterator[tuple[Any, ...]]:
        """One comparison per prior, in the order of ``priors``, for every kind of context at every level.

        ``act``: the model as a policy, by Algorithm 1.  ``heldout``: contexts of test tasks, else of training tasks.
        """
        ...

    def summary(self, found: Sequence[Any]) -> Mapping[str, Any]:
        """All comparisons of one prior in numbers, by suffix of the measure's name, in nats.

        ``""``, ``_standard_error``, ``_goal_met``, ``_goal_unmet``: the mean, its standard error, the means after and
        before the goal was reached (None without such contexts); ``_cells``: a row per comparison with ``kind``,
        ``p``, ``kl``, ``standard_error``, ``contexts`` (their number), ``goal_met``, ``goal_unmet`` and ``met``, the share
        with the goal reached.
        """
        ...

    def curves(self, found: Sequence[Any]) -> Mapping[str, Any]:
        """Data of the figure, as JSON values.

        ``by_prefix``: a map per comparison with ``kind``, ``p`` and ``kl``, a number of nats per prefix length;
        ``agreement``: lists of equal length, ``exact`` and ``model``: probabilities of actions, averaged in bins.
        """
        ...


class Certificate(Protocol):
    """``Problem.certify``: exact expected returns of policies that are fixed within an episode (Markov policies).

    Under Algorithm 1 the context is frozen within an episode, so an in-context agent is such a policy, given its context.
    ``policies`` are probabilities at the C ``states``, P = B policies, one for each variation, or P = 1, one for all.  Returns
    are undiscounted, of one test episode.
    """

    @property
    def states(self) -> Float32[np.ndarray, "C S"]:
        """All states of the problem, as observations."""
        ...

    def worst(
        self, policies: Float[np.ndarray, "P C A"] | None, variations: Sequence[Variation], p: float
    ) -> Float64[np.ndarray, " B"]:
        """Against the worst override adversary of strength p in each variation's task, whatever the variation's own adversary.

        ``policies`` None: the policy that is best against it.
        """
        ...

    def expected(self, policies: Float[np.ndarray, "P C A"], variations: Sequence[Variation]) -> Float64[np.ndarray, " B"]:
        """Under the adversary of each variation."""
        ...


class TwoPlayerBatch(Protocol):
    """B tasks stepped together, in which agent and adversary act simultaneously."""

    spec: Spec
    """The agent's spec; the adversary has the same observations."""
    batch: int
    disturbance: int
    """Components of the adversary's action, F."""

    def reset(self, rngs: Sequence[np.random.Generator]) -> Float32[np.ndarray, "B S"]:
        """Start an episode in every row."""
        ...

    def step(self, actions: Float32[np.ndarray, "B A"], disturbances: Float32[np.ndarray, "B F"]) -> Step:
        """Execute both actions in every row, each in [-1, 1].  Raises RuntimeError past the horizon."""
        ...


class SecondPlayer(Protocol):
    """``Problem.second_player``: the adversary as a player that can be trained."""

    @property
    def strength(self) -> float:
        """Strength of its largest action with the problem's settings.  Raises ConfigError if it is not known."""
        ...

    def batch(self, tasks: Sequence[Task], strength: float) -> TwoPlayerBatch:
        """These tasks; a disturbance of 1 has this strength."""
        ...


class GameBelief(Protocol):
    """The agent's belief about the goal in a game."""

    @property
    def implied(self) -> Float64[np.ndarray, " C"]:
        """The posterior over goals that the agent's distributions imply, by cell."""
        ...

    @property
    def exact(self) -> Float64[np.ndarray, " C"]:
        """The exact posterior given the same context, by cell."""
        ...

    @property
    def divergence(self) -> float:
        """KL divergence of the agent's distributions from their best mixture of optimal policies, nats."""
        ...

    @property
    def transitions(self) -> int:
        """Number of transitions in the context."""
        ...


class Game(Protocol):
    """A game against an agent (``icrl-dist play``); the calls are those of ``monitor/player.py``, from one thread.

    The page (``monitor/assets/play.html``) draws a square room, so another problem's game must look like one.
    """

    @property
    def wait_s(self) -> float | None:
        """Seconds between two steps; 0 for steps at full speed, None while paused."""
        ...

    def pause(self, paused: bool) -> None:
        """Pause or continue."""
        ...

    def step(self) -> None:
        """One step of the agent and the environment."""
        ...

    def snapshot(self) -> dict[str, Any]:
        """The state that the page draws, as JSON values: the keys of ``problems/darkroom/game.py`` ``PlayGame.snapshot``."""
        ...

    def history(self) -> dict[str, Any]:
        """The finished episodes as JSON columns of equal length, and ``first``, the number of the first one, from 1.

        Columns: ``total`` (return), ``optimum`` (or None), ``overridden`` and ``by_hand`` (steps).
        """
        ...

    def belief(self) -> GameBelief:
        """The agent's belief now."""
        ...

    def command(self, fields: dict[str, Any]) -> None:
        """Execute a viewer's command, a map with ``do`` and maybe ``value``.  Raises ValueError with the expected value."""
        ...


MakeGame = Callable[["InContextAgent", "Run", int], Game]
"""``make(agent, run, seed)``: a game against this agent, which ``run`` trained."""
