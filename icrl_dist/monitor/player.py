"""The loop of ``icrl-dist play``: one thread owns the game, and any number of viewers watch and control it."""

from __future__ import annotations

import queue
import time
from concurrent.futures import Future
from pathlib import Path
from threading import Event
from typing import Any

from rich.console import Console

from icrl_dist.agent.loading import load_agent
from icrl_dist.config.run import ConfigError, Deployment, parse_written
from icrl_dist.monitor.event_stream import EventStream
from icrl_dist.monitor.serve import application, serving
from icrl_dist.problems import registry as problems
from icrl_dist.problems.parts import Game

FRAME_S, BELIEF_S, HURRY_S = 0.05, 0.15, 0.25
"""Minimum time between two states sent, between two beliefs, and between two states while steps run at full speed."""
_ANSWER_S = 10.0


class Player:
    """Steps a game at its speed while viewers are connected.

    Only the thread in ``run`` accesses the game; ``command`` may be called from any thread.
    """

    def __init__(self, game: Game, stream: EventStream) -> None:
        self._game, self._stream = game, stream
        self._orders: queue.SimpleQueue[tuple[dict[str, Any], Future[None]]] = queue.SimpleQueue()

    def command(self, fields: dict[str, Any]) -> None:
        """Execute a command in the thread of the game and wait for it.  Raises ValueError as ``Game.command`` does."""
        done: Future[None] = Future()
        self._orders.put((fields, done))
        try:
            done.result(_ANSWER_S)
        except TimeoutError:
            raise ValueError(f"no answer from the game for {_ANSWER_S:g} s: try again") from None

    def run(self, over: Event) -> None:
        """Play until ``over`` is set."""
        step_at = frame_at = belief_at = 0.0
        picture = belief = True  # whether the newest state and belief are not sent yet
        finished = -1
        while not over.is_set():
            game, now = self._game, time.monotonic()
            wait = game.wait_s if self._stream.viewers else None
            if wait is not None and now >= step_at:
                game.step()
                step_at = max(step_at + wait, now)
                picture = belief = True
            if belief and now >= belief_at and wait != 0.0:
                self._show_belief()
                belief, belief_at = False, time.monotonic() + BELIEF_S
            if picture and now >= frame_at:
                self._stream.publish("room", game.snapshot(), state=True)
                picture, frame_at = False, now + (HURRY_S if wait == 0.0 else FRAME_S)
                history = game.history()
                if (marks := history["first"] + len(history["total"])) != finished:
                    self._stream.publish("episodes", history, state=True)
                    finished = marks
            ahead = [t for t, wanted in ((step_at, wait is not None), (frame_at, picture), (belief_at, belief)) if wanted]
            pause = min([0.1, *(t - time.monotonic() for t in ahead)])
            if self._obey(max(0.0, pause)):
                picture, belief, finished = True, True, -1

    def _obey(self, wait_s: float) -> bool:
        """Execute the commands that arrive within ``wait_s``; returns whether there were any."""
        obeyed = False
        try:
            while True:
                fields, done = self._orders.get(timeout=0 if obeyed else wait_s) if wait_s else self._orders.get_nowait()
                obeyed = True
                try:
                    self._game.command(fields)
                except ValueError as error:
                    done.set_exception(error)
                else:
                    done.set_result(None)
        except queue.Empty:
            return obeyed

    def _show_belief(self) -> None:
        read = self._game.belief()
        columns = {"implied": read.implied, "exact": read.exact}
        apart = float(abs(read.implied - read.exact).sum() / 2)
        fields = {name: [round(float(p), 5) for p in column] for name, column in columns.items()}
        more = {"divergence": round(read.divergence, 4), "apart": round(apart, 4), "transitions": read.transitions}
        self._stream.publish("belief", {**fields, **more}, state=True)


def play(
    what: str | Path, where: tuple[str, int], deploy: Deployment | None, seed: int, paused: bool, console: Console
) -> None:
    """Serve the game at ``where``, host and port, until interrupted.

    Raises ConfigError if the agent is not for Dark Room, or if the address cannot be used.
    """
    agent = load_agent(what, seed, deploy)
    run = parse_written(str(agent.manifest.get("run", "")), str(what))
    make_game = problems.of(run).game
    if make_game is None:
        raise ConfigError(f"play {what}: its agent is for {run.problem}, which cannot be played; use an agent of darkroom")
    stream, game = EventStream(), make_game(agent, run, seed)
    game.pause(paused)
    player = Player(game, stream)
    with serving(application("play.html", stream, player.command), stream, *where) as url:
        console.print(f"{url}: the page of the game (Ctrl-C ends the game)", highlight=False, markup=False)
        player.run(Event())
