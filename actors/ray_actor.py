"""The process that Ray makes for a worker, and the worker's whole life in it."""

from __future__ import annotations

from pathlib import Path


class _Host:
    """The Ray actor: a process for one worker.

    A spare one waits with everything imported, so that a worker that dies is replaced at once
    and not after the seconds that a new process takes.
    """

    def __init__(self) -> None:
        import actors.worker  # noqa: F401 (and torch, which takes the longest)
        import icrl_dist.stream.zenoh_link  # noqa: F401

    def work(self, endpoint: str, run_name: str, name: str, folder: str | None, certificates: str) -> None:
        """A worker's whole life."""
        import torch

        from actors import router
        from actors.worker import Worker
        from icrl_dist.stream.zenoh_link import ZenohLink

        torch.set_num_threads(1)
        where, settings = router.reached(endpoint, certificates)
        with ZenohLink.connect(where, timeout_s=30.0, config=settings) as link:
            Worker(link, run_name, name, folder=Path(folder) if folder else None).run()
