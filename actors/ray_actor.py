"""The Ray actor of a worker: one process that runs one worker."""

from __future__ import annotations

from pathlib import Path


class WorkerActor:
    """A process for one worker.  ``icrl_dist.telemetry.processes`` finds workers by this class name in the process title.

    A spare actor has imported everything and waits, so that it replaces a dead worker at once and not
    after the seconds that a new process takes to start.
    """

    def __init__(self) -> None:
        import actors.worker  # noqa: F401 (and torch, which takes longest)
        import icrl_dist.stream.zenoh_link  # noqa: F401

    def work(self, endpoint: str, run_name: str, name: str, folder: str | None, certificates: str) -> None:
        """Run a worker until the learner stops it."""
        import torch

        from actors import router
        from actors.worker import Worker
        from icrl_dist.stream.zenoh_link import ZenohLink

        torch.set_num_threads(1)
        address, settings = router.connection(endpoint, certificates)
        with ZenohLink.connect(address, timeout_s=30.0, config=settings) as link:
            Worker(link, run_name, name, folder=Path(folder) if folder else None).run()
