"""The workers' lives: start them with Ray, watch them, start them again.  The only Ray import.

Ray places and restarts workers and carries no arrays; every byte of data goes over the link.
"""

from __future__ import annotations

import contextlib
import logging
import os
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from icrl_dist import endpoints
from icrl_dist.config import ConfigError

_SETTINGS = {
    "RAY_USAGE_STATS_ENABLED": "0",
    "RAY_ACCEL_ENV_VAR_OVERRIDE_ON_ZERO": "0",
    "RAY_worker_niceness": "0",  # Ray's 15 starves the workers as soon as anything else runs
}
JOIN_S = 600.0
"""Seconds that the machines of a cluster have to join it; the first time they install everything."""


class FleetFailed(RuntimeError):  # noqa: N818
    """Workers keep dying; the message names the last cause."""


def _work(endpoint: str, run_name: str, name: str, folder: str | None, certificates: str) -> None:
    """A worker's whole life, in a process that Ray made."""
    import torch

    from actors.worker import Worker
    from icrl_dist.stream import security
    from icrl_dist.stream.zenoh_link import ZenohLink

    torch.set_num_threads(1)
    with ZenohLink.connect(endpoint, timeout_s=30.0, config=security.client(certificates, "worker")) as link:
        Worker(link, run_name, name, folder=Path(folder) if folder else None).run()


def check_cores(actors: int) -> None:
    """Raises ConfigError if this machine has fewer cores than ``actors``: they would wait for ever."""
    cores = len(os.sched_getaffinity(0))
    if actors > cores:
        raise ConfigError(f"--actors {actors}: this machine has {cores} cores; ask for at most {cores}")


class Fleet:
    """``actors`` Ray workers spread over the machines, each restarted at most ``restarts`` times in a row."""

    def __init__(self, actors: int, restarts: int, address: str | None = None, oversubscribe: bool = False) -> None:
        """Starts Ray here, or joins the cluster at ``address``.

        Raises ConfigError if this machine has fewer cores than workers, unless they may share
        them (``oversubscribe``): they would wait for ever.
        """
        os.environ.update(_SETTINGS)
        import ray

        self._ray: Any = ray
        if address is None:
            if not oversubscribe:
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
            try:
                ray.init(address=address, log_to_driver=False, logging_level=logging.ERROR)
            except (ConnectionError, ray.exceptions.AuthenticationError) as error:
                raise ConfigError(f"--address {address}: {error}; `ray status` there says whether a cluster is up") from None
        self._address, self._placed, self._noted = address, False, False
        self.deaths = 0
        """Workers that died, however it happened."""
        self._actors, self._restarts = actors, restarts
        self._budget = dict.fromkeys(range(actors), restarts)
        self._at_death = dict.fromkeys(range(actors), -1)
        self._running: dict[Any, tuple[int, Any]] = {}
        self._spare: Any = None
        self._lives = dict.fromkeys(range(actors), 0)
        self._endpoint = self._run_name = self._certificates = ""
        self._folder: str | None = None

    def start(self, endpoint: str, run_name: str, folder: Path | None = None, certificates: str = "") -> None:
        """Take up the run whose learner is reached at ``endpoint``; ``watch`` launches its workers.

        ``folder``: the run's, for crash records and stacks where a worker's machine has it too.
        ``certificates``: their folder on the workers' machines, empty without TLS.
        """
        self._endpoint, self._run_name, self._certificates = endpoint, run_name, certificates
        self._folder = str(folder.absolute()) if folder is not None else None
        self._deadline = time.monotonic() + JOIN_S

    def _place(self, note: Callable[[str], None]) -> None:
        """Launch every worker once the cluster has a core for each: its machines join one by one.

        Raises ConfigError if they do not, or if other machines could not reach the learner.
        """
        cores = int(self._ray.cluster_resources().get("CPU", 0))
        if cores < self._actors:
            text = f"the cluster at {self._address} has {cores} cores for {self._actors} workers"
            if time.monotonic() > self._deadline:
                raise ConfigError(
                    f"{text} after {JOIN_S:.0f} s: ask for fewer with --actors; `ray status` says which machines are there"
                )
            if not self._noted:
                note(f"{text} so far: waiting for more machines to join")
                self._noted = True
            return
        several = sum(node["Alive"] for node in self._ray.nodes()) > 1
        if self._address is not None and several and endpoints.parse(self._endpoint).loopback:
            raise ConfigError(
                f"stream.endpoint = {self._endpoint!r}: other machines cannot reach it; name an address of this one, "
                "as in --stream.endpoint tls/HEAD_IP:7447 --stream.certificates FOLDER"
            )
        for index in range(self._actors):
            self._launch(index)
        self._placed = True

    def _host(self, cpus: int) -> Any:
        return self._ray.remote(num_cpus=cpus, max_restarts=0, scheduling_strategy="SPREAD")(_Host).remote()

    def _launch(self, index: int) -> None:
        host, self._spare = self._spare or self._host(1), None
        name = f"w{index}" if not self._lives[index] else f"w{index}-{self._lives[index]}"
        self._running[host.work.remote(self._endpoint, self._run_name, name, self._folder, self._certificates)] = (index, host)

    def watch(self, note: Callable[[str], None], progress: int) -> int:
        """Look after the workers once: restart those that died; returns how many are at work or to come.

        ``progress`` is any number that grows while the run gets on, such as trajectories stored:
        when it has grown since a worker's last death, that worker's budget is whole again.
        Raises FleetFailed when a worker has died more often than its budget allows.
        """
        if not self._placed:
            self._place(note)
        elif progress and self._spare is None and self._address is None:
            self._spare = self._host(0)  # a cluster has no place that costs nothing
        ready, _ = self._ray.wait(list(self._running), num_returns=len(self._running), timeout=0) if self._running else ([], [])
        for done in ready:
            index, _host = self._running.pop(done)
            try:
                self._ray.get(done)
            except Exception as error:
                cause = _cause(error)
                self.deaths += 1
                if progress > self._at_death[index]:
                    self._budget[index] = self._restarts
                self._at_death[index] = progress
                if self._budget[index] == 0:
                    times = self._restarts + 1
                    raise FleetFailed(f"worker w{index} died {times} times without progress; last: {cause}") from None
                self._budget[index] -= 1
                self._lives[index] += 1
                note(f"worker w{index} died ({cause}); starting it again")
                self._launch(index)
        return len(self._running) if self._placed else self._actors

    def close(self) -> None:
        """End every worker, and Ray if it was started here."""
        for host in [host for _, host in self._running.values()] + [self._spare] * (self._spare is not None):
            with contextlib.suppress(Exception):
                self._ray.kill(host)
        self._running.clear()
        self._ray.shutdown()


class _Host:
    """The Ray actor: a process for one worker.

    A spare one waits with everything imported, so that a worker that dies is replaced at once
    and not after the seconds that a new process takes.
    """

    def __init__(self) -> None:
        import actors.worker  # noqa: F401 (and torch, which takes the longest)
        import icrl_dist.stream.zenoh_link  # noqa: F401

    def work(self, endpoint: str, run_name: str, name: str, folder: str | None, certificates: str) -> None:
        _work(endpoint, run_name, name, folder, certificates)


def _cause(error: BaseException) -> str:
    lines = [line for line in str(error).splitlines() if line.strip()]
    return lines[-1].strip()[:200] if lines else type(error).__name__
