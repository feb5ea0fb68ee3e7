"""The live view in a terminal."""

from __future__ import annotations

from textual.app import App

from icrl_dist.monitor.feed import Feed


class Screen(App[None]):
    """One run, live or played again."""

    def __init__(self, feed: Feed) -> None:
        super().__init__()
        self._feed = feed
