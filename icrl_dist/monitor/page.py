"""The live view in a browser."""

from __future__ import annotations

from rich.console import Console

from icrl_dist.monitor.feed import Feed


def serve(feed: Feed, host: str, port: int, console: Console) -> int:
    """Serve the page until Ctrl-C; returns the exit code."""
    raise NotImplementedError
