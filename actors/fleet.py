"""The workers' lives: start them with Ray, watch them, start them again.  The only Ray import.

Ray places and restarts workers and carries no arrays; every byte of data goes over the link.
"""

from __future__ import annotations

import contextlib
import logging
import os
from collections.abc import Callable
from typing import Any

from icrl_dist.config import ConfigError

_SETTINGS = {
    "RAY_USAGE_STATS_ENABLED": "0",
    "RAY_ACCEL_ENV_VAR_OVERRIDE_ON_ZERO": "0",
    "RAY_worker_niceness": "0",  # Ray's 15 starves the workers as soon as anything else runs
}


class FleetFailed(RuntimeError):  # noqa: N818
    """Workers keep dying; the message names the last cause."""


def _work(endpoint: str, run_name: str, name: str) -> None:
    """A worker's whole life, in a process that Ray made."""
    import torch

    from actors.worker import Worker
    from icrl_dist.stream.zenoh_link import ZenohLink

    torch.set_num_threads(1)
    with ZenohLink.connect(endpoint, timeout_s=30.0) as link:
        Worker(link, run_name, name).run()


def check_cores(actors: int) -> None:
    """Raises ConfigError if this machine has fewer cores than ``actors``: they would wait for ever."""
    cores = len(os.sched_getaffinity(0))
    if actors > cores:
        raise ConfigError(f"--actors {actors}: this machine has {cores} cores; ask for at most {cores}")


class Fleet:
    """``actors`` Ray workers, each restarted at most ``restarts`` times."""

    def __init__(self, actors: int, restarts: int, address: str | None = None) -> None:
        """Starts Ray here, or joins the cluster at ``address``.

        Raises ConfigError if there are fewer cores than workers: they would wait for ever.
        """
        os.environ.update(_SETTINGS)
        import ray

        self._ray: Any = ray
        if address is None:
            check_cores(actors)
            ray.init(
                num_cpus=actors,
                object_store_memory=100 << 20,
                _node_ip_address="127.0.0.1",
                include_dashboard=False,
                log_to_driver=False,
                logging_level=logging.ERROR,
            )
        else:
            ray.init(address=address, log_to_driver=False, logging_level=logging.ERROR)
            cores = int(self._ray.cluster_resources().get("CPU", 0))
            if actors > cores:
                ray.shutdown()
                raise ConfigError(f"--actors {actors}: the cluster at {address} has {cores} cores; ask for at most {cores}")
        self._actors, self._budget = actors, dict.fromkeys(range(actors), restarts)
        self._running: dict[Any, tuple[int, Any]] = {}
        self._lives = dict.fromkeys(range(actors), 0)
        self._endpoint = self._run_name = ""

    def start(self, endpoint: str, run_name: str) -> None:
        """Start every worker of the run whose learner listens at ``endpoint``."""
        self._endpoint, self._run_name = endpoint, run_name
        for index in range(self._actors):
            self._launch(index)

    def _launch(self, index: int) -> None:
        host = self._ray.remote(num_cpus=1, max_restarts=0)(_Host).remote()
        name = f"w{index}" if not self._lives[index] else f"w{index}-{self._lives[index]}"
        self._running[host.work.remote(self._endpoint, self._run_name, name)] = (index, host)

    def watch(self, note: Callable[[str], None]) -> int:
        """Look after the workers once: restart those that died; returns how many are at work.

        Raises FleetFailed when a worker has died more often than its budget allows.
        """
        ready, _ = self._ray.wait(list(self._running), num_returns=len(self._running), timeout=0) if self._running else ([], [])
        for done in ready:
            index, _host = self._running.pop(done)
            try:
                self._ray.get(done)
            except Exception as error:
                cause = _cause(error)
                if self._budget[index] == 0:
                    raise FleetFailed(f"worker w{index} died {self._lives[index] + 1} times; last: {cause}") from None
                self._budget[index] -= 1
                self._lives[index] += 1
                note(f"worker w{index} died ({cause}); starting it again")
                self._launch(index)
        return len(self._running)

    def close(self) -> None:
        """End every worker, and Ray if it was started here."""
        for _, host in self._running.values():
            with contextlib.suppress(Exception):
                self._ray.kill(host)
        self._running.clear()
        self._ray.shutdown()


class _Host:
    """The Ray actor: a process for one worker."""

    def work(self, endpoint: str, run_name: str, name: str) -> None:
        _work(endpoint, run_name, name)


def _cause(error: BaseException) -> str:
    lines = [line for line in str(error).splitlines() if line.strip()]
    return lines[-1].strip()[:200] if lines else type(error).__name__
