"""The workers' lives: start them with Ray, watch them, start them again.  The only Ray import.

Ray places and restarts workers and carries no arrays; every byte of data goes over the link.
"""

from __future__ import annotations

import contextlib
import logging
import os
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from actors import local
from actors.cluster import Cluster, brief
from actors.placement import Machine, Placement
from actors.ray_actor import _Host
from icrl_dist.config.run import ConfigError

_SETTINGS = {
    "RAY_USAGE_STATS_ENABLED": "0",
    "RAY_ACCEL_ENV_VAR_OVERRIDE_ON_ZERO": "0",
    "RAY_worker_niceness": "0",  # Ray's 15 starves the workers as soon as anything else runs
}
JOIN_S = 600.0
"""Seconds that the machines of a cluster have to join it; the first time they install everything."""
SHORT_S = 45.0
"""Seconds after which a run says which machines are missing, and why."""
PROBES_S = 10.0
"""Seconds that a run, when it has enough machines, waits for those that have not said yet whether they are fit."""
NOTE_S = 5.0
"""Seconds after which a run says that it waits."""
DOUBT_S = 6.0
"""How a worker ended that was on a machine which does not answer is looked at again so often."""
SOON_S = 60.0
"""A worker that died so shortly before its machine did not die by itself."""
_PAUSE_S = 0.25


class FleetFailed(RuntimeError):  # noqa: N818
    """Workers keep dying, or Ray does not start; the message names the last cause."""


def check_cores(actors: int) -> None:
    """Raises ConfigError if this machine has fewer cores than ``actors``: they would wait for ever."""
    cores = len(os.sched_getaffinity(0))
    if actors > cores:
        raise ConfigError(f"--actors {actors}: this machine has {cores} cores; ask for at most {cores}")


class Fleet:
    """Ray workers spread over the machines, each restarted at most ``restarts`` times in a row.

    On a cluster machines may join and leave at any time: workers are placed where there is room, and
    those of a machine that left go elsewhere, or wait for one.
    """

    def __init__(
        self,
        actors: int | None,
        restarts: int,
        address: str | None = None,
        oversubscribe: bool = False,
        at_least: int | None = None,
        note: Callable[[str], None] = lambda text: None,
        stopped: Callable[[], bool] = lambda: False,
    ) -> None:
        """Starts Ray here, or joins the cluster at ``address``.

        ``actors``: how many workers, on a cluster as many as it has cores if None.  ``at_least``: so
        many are enough to begin with, when others have not joined for ``SHORT_S``; ``actors`` of
        them, or one, if None.  Raises ConfigError if this machine has fewer cores than workers, unless
        they may share them (``oversubscribe``): they would wait for ever; FleetFailed if Ray does not
        start here, of which ``note`` is told each time, or did not and ``stopped``.
        """
        os.environ.update(_SETTINGS)
        import ray

        self._ray: Any = ray
        self._address, self._restarts = address, restarts
        self._at_least = at_least or actors or 1
        if address is None:
            actors = actors or 1
            if not oversubscribe:
                check_cores(actors)
            try:
                local.begin(ray, note, stopped, num_cpus=actors, object_store_memory=100 << 20, _node_ip_address="127.0.0.1")
            except RuntimeError as error:
                raise FleetFailed(str(error)) from error
        else:
            try:
                ray.init(address=address, log_to_driver=False, logging_level=logging.ERROR)
            except (ConnectionError, ray.exceptions.AuthenticationError) as error:
                raise ConfigError(f"--address {address}: {error}; `ray status` there says whether a cluster is up") from None
        self.deaths = 0
        """Workers that died, however it happened; those that went with their machine are not among them."""
        self._placement = Placement(actors)
        self._cluster = Cluster(ray, self._placement) if address is not None else None
        if address is None:
            self._placement.join(Machine("", "127.0.0.1", "", actors or 1))
        self._budget: dict[int, int] = {}
        self._at_death: dict[int, int] = {}
        self.lost: list[str] = []
        """Names of those, in the order in which it became known: nothing that they did is to blame."""
        self._running: dict[Any, tuple[int, Any, str]] = {}
        self._doubtful: list[_Doubt] = []
        self._recent: list[tuple[float, int, str, str]] = []
        """Deaths that counted: when, whose, on which machine, and under which name."""
        self._spare: Any = None
        self._lives: dict[int, int] = {}
        self._endpoint = self._run_name = self._certificates = ""
        self._folder: str | None = None
        self._alone_since: float | None = None

    def gather(
        self, endpoint: str, connect: str, certificates: str, note: Callable[[str], None], stopped: Callable[[], bool]
    ) -> None:
        """Wait until the cluster's machines are here, each fit and able to reach the learner-to-be; nothing to do without one.

        ``endpoint`` and ``connect`` as in ``config.StreamConfig``.  Returns early once ``stopped``.  After
        ``SHORT_S`` it names what is missing and begins with what there is, if that is enough.
        Raises ConfigError for a machine that does not fit, or if there are too few after ``JOIN_S``.
        """
        if self._cluster is None:
            return
        self._cluster.look_for(endpoint, connect, certificates)
        began, noted, told = time.monotonic(), False, False
        since: float | None = None
        with self._cluster.listening(endpoint, connect):
            while not stopped():
                unfit = self._cluster.refresh(note)
                if unfit:
                    raise ConfigError("; ".join(unfit))
                waited, room, wanted = time.monotonic() - began, self._placement.room, self._placement.wanted
                enough = room >= self._at_least and (wanted is not None or not self._cluster.absent()) and room >= (wanted or 1)
                since = None if not enough else since or time.monotonic()
                # Nobody listens for some seconds after this: who was asked should have tried by then.
                if since and (not self._cluster.undecided or time.monotonic() - since >= PROBES_S):
                    return
                text = f"the cluster at {self._address} has {room} cores for {wanted or 'its'} workers"
                if waited >= NOTE_S and not noted:
                    noted = True
                    note(f"{text} so far: waiting for more machines to join")
                if waited >= SHORT_S and not told:
                    told = True
                    for line in self._cluster.absent() or [f"{text}: no machine is missing by its cluster file"]:
                        note(line)
                if waited >= SHORT_S and room >= self._at_least:
                    note(f"beginning with {room} workers; others join when their machines do")
                    return
                if waited >= JOIN_S:
                    raise ConfigError(
                        f"{text} after {JOIN_S:.0f} s: ask for fewer with --actors or --min-actors; "
                        "`ray status` says which machines are there"
                    )
                time.sleep(_PAUSE_S)

    def start(self, endpoint: str, run_name: str, folder: Path | None = None, certificates: str = "") -> None:
        """Take up the run whose learner is reached at ``endpoint``; ``watch`` launches its workers.

        ``folder``: the run's, for crash records and stacks where a worker's machine has it too.
        ``certificates``: their folder on the workers' machines, empty without TLS.
        """
        self._endpoint, self._run_name, self._certificates = endpoint, run_name, certificates
        self._folder = str(folder.absolute()) if folder is not None else None
        if self._cluster is not None:
            self._cluster.listens(endpoint)

    def _host(self, cpus: int, node: str = "") -> Any:
        where: Any = "SPREAD"
        if node:
            where = self._ray.util.scheduling_strategies.NodeAffinitySchedulingStrategy(node, soft=False)
        return self._ray.remote(num_cpus=cpus, max_restarts=0, scheduling_strategy=where)(_Host).remote()

    def _name(self, index: int) -> str:
        lives = self._lives.get(index, 0)
        return f"w{index}-{lives}" if lives else f"w{index}"

    def _launch(self, index: int, node: str) -> None:
        host, self._spare = self._spare or self._host(1, node), None
        work = host.work.remote(self._endpoint, self._run_name, self._name(index), self._folder, self._certificates)
        self._running[work] = (index, host, node)

    def watch(self, note: Callable[[str], None], progress: int) -> int:
        """Look after the workers once: restart those that died; returns how many are at work or to come.

        ``progress`` is any number that grows while the run gets on, such as trajectories stored:
        when it has grown since a worker's last death, that worker's budget is whole again.
        Raises FleetFailed when a worker has died more often than its budget allows, or when there
        has been no machine for ``JOIN_S``.
        """
        if self._cluster is not None:
            for line in self._cluster.refresh(note):
                note(f"{line}; no worker is placed there")
        elif progress and self._restarts and self._spare is None:
            self._spare = self._host(0)  # a cluster has no place that costs nothing
        ready, _ = self._ray.wait(list(self._running), num_returns=len(self._running), timeout=0) if self._running else ([], [])
        due = [doubt for doubt in self._doubtful if time.monotonic() >= doubt.due]
        self._doubtful = [doubt for doubt in self._doubtful if doubt not in due]
        for done in ready:
            index, host, node = self._running.pop(done)
            try:
                self._ray.get(done)
            except Exception as error:
                due.append(_Doubt(index, host, node, error))
            else:
                self._leaves_its_place(index)
        for doubt in due:
            self._ended(doubt, note, progress)
        if self._cluster is not None:  # before anyone is launched anew: names are of one life
            self._forget_those_that_went_with_their_machine()
        settled = self._placement.settle()
        for index, machine in settled:
            self._launch(index, machine.node)
        if settled and self._cluster is not None:
            note(f"workers: {self._placement.landed(self._name)}")
        self._not_alone()
        return len(self._running) + len(self._doubtful) + len(self._placement.waiting)

    def _forget_those_that_went_with_their_machine(self) -> None:
        gone = {work: one for work, one in self._running.items() if one[2] not in self._placement.machines}
        for work, (index, host, _) in gone.items():
            del self._running[work]
            self._went(index, host)
        for doubt in [doubt for doubt in self._doubtful if doubt.node not in self._placement.machines]:
            self._doubtful.remove(doubt)
            self._went(doubt.index, doubt.host)
        self._recent = [one for one in self._recent if time.monotonic() - one[0] < SOON_S]
        for death in list(self._recent):
            _, index, node, name = death
            if node not in self._placement.machines:
                self._recent.remove(death)  # a machine that is shut down ends its workers before Ray's own process
                self.lost.append(name)
                self.deaths -= 1
                self._budget[index] = min(self._restarts, self._budget[index] + 1)

    def _went(self, index: int, host: Any) -> None:
        """A worker is lost with its machine: that is no fault of its own."""
        self.lost.append(self._name(index))
        self._lives[index] = self._lives.get(index, 0) + 1
        self._kill(host)  # it may be alive, cut off for good

    def _kill(self, host: Any) -> None:
        with contextlib.suppress(Exception):
            self._ray.kill(host)

    def _leaves_its_place(self, index: int) -> None:
        """It was told to stop: nobody stands where it stood, and nobody comes."""
        if (machine := self._placement.where(index)) is not None:
            machine.workers.discard(index)
            machine.cores -= 1

    def _ended(self, doubt: _Doubt, note: Callable[[str], None], progress: int) -> None:
        """A worker died: with its machine, or by itself, which counts.

        Ray calls a machine alive for a quarter of a minute and more after its end, but knows of a
        broken connection at once: while a machine does not answer, nothing is decided.
        """
        index, host, node, error = doubt.index, doubt.host, doubt.node, doubt.error
        if self._cluster is not None:
            if self._cluster.lost(node, note):
                self._went(index, host)
                return
            if isinstance(error, self._ray.exceptions.RayActorError) and not self._cluster.answers(node):
                self._doubtful.append(_Doubt(index, host, node, error, time.monotonic() + DOUBT_S))
                return
            self._kill(host)  # it may be alive, and nobody would see its end
            self._recent.append((time.monotonic(), index, node, self._name(index)))
        self._lives[index] = self._lives.get(index, 0) + 1
        self.deaths += 1
        cause = brief(error)
        if progress > self._at_death.get(index, -1):
            self._budget[index] = self._restarts
        self._at_death[index] = progress
        if self._budget.setdefault(index, self._restarts) == 0:
            times = self._restarts + 1
            raise FleetFailed(f"worker w{index} died {times} times without progress; last: {cause}") from None
        self._budget[index] -= 1
        note(f"worker w{index} died ({cause}); starting it again")
        if self._placement.where(index) is not None:
            self._launch(index, node)
        else:
            self._placement.waiting.append(index)

    def _not_alone(self) -> None:
        """Raises FleetFailed if the last machine went long ago."""
        if self._cluster is None or self._placement.machines:
            self._alone_since = None
        elif self._alone_since is None:
            self._alone_since = time.monotonic()
        elif time.monotonic() - self._alone_since > JOIN_S:
            raise FleetFailed(f"no machine has been there to work for {JOIN_S:.0f} s; `ray status` says why")

    def close(self) -> None:
        """End every worker, and Ray if it was started here."""
        for host in [host for _, host, _ in self._running.values()] + [self._spare] * (self._spare is not None):
            self._kill(host)
        self._running.clear()
        self._ray.shutdown()


@dataclass(frozen=True, eq=False)
class _Doubt:
    """A worker that has ended, by itself or with its machine."""

    index: int
    host: Any
    node: str
    error: Exception
    due: float = 0.0
