"""Fleet: starts the workers with Ray, supervises them, and restarts them, and Ray itself.  The only import of Ray.

Ray places and restarts workers and carries no arrays; all data goes over the link.
"""

from __future__ import annotations

import contextlib
import logging
import os
import time
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

from actors import local
from actors.cluster import Cluster, brief
from actors.placement import EndedWorker, Node, Placement, check_cores
from actors.ray_actor import WorkerActor
from actors.running_time import RunningTime
from actors.session import Session, SessionFailed, sigterm_unchanged
from icrl_dist.config.run import ConfigError
from icrl_dist.diagnostics import ray_job
from icrl_dist.diagnostics.ray_address import require_cluster

_SETTINGS = {
    "RAY_USAGE_STATS_ENABLED": "0",
    "RAY_ACCEL_ENV_VAR_OVERRIDE_ON_ZERO": "0",
    "RAY_DISABLE_FAILURE_SIGNAL_HANDLER": "1",  # else the end of Ray resets SIGTERM: a second one kills the command at once
    "RAY_worker_niceness": "0",  # with Ray's default of 15, any other process starves the workers
}
_LOCAL_SETTINGS = {
    "RAY_gcs_rpc_server_reconnect_timeout_s": "300",  # Ray aborts its processes, and this one, so long after the end of its GCS
}
JOIN_S = 600.0
"""Seconds that the nodes of a cluster have to join; they install everything when they start for the first time."""
REPORT_MISSING_S = 45.0
"""Seconds after which a run reports which nodes are missing, and why."""
CHECKS_S = 10.0
"""Seconds that a run with enough nodes waits for the checks of further nodes."""
NOTE_S = 5.0
"""Seconds after which a run reports that it waits."""
RECHECK_S = 6.0
"""Seconds between two attempts to find out how a worker ended whose node cannot be reached."""
NODE_FAILURE_S = 60.0
"""A death of a worker this many seconds or less before its node left was caused by the node."""
_PAUSE_S = 0.25


class FleetFailed(RuntimeError):  # noqa: N818
    """Workers die repeatedly, or Ray does not start; the message contains the last cause."""


class Fleet:
    """Ray workers spread over the nodes, each restarted at most ``restarts`` times in a row.

    Nodes of a cluster may join and leave at any time: workers are placed where cores are free, and the
    workers of a node that left move to other nodes or wait for one.
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
        """Start Ray on this machine, or connect to the cluster at ``address``.

        ``actors``: the number of workers; None on a cluster: one per core.  ``at_least``: the number of
        workers with which a run starts if nodes are missing after ``REPORT_MISSING_S``; by default
        ``actors``, or 1.  Raises ConfigError if this machine has fewer cores than workers and not
        ``oversubscribe``: the remaining workers would never start.  Raises FleetFailed if Ray does not
        start here (``session.Session`` gets ``note`` and ``stopped``), and ConfigError if there is no cluster at
        ``address``.  The environment variables that Ray needs are set until ``close``.
        """
        local.refuse_running_session()
        self._address, self._restarts = address, restarts
        self._at_least = at_least or actors or 1
        if address is None:
            actors = actors or 1
            if not oversubscribe:
                check_cores(actors)
        self._variables = local.variables()
        os.environ.update(_SETTINGS)
        self._session: Session | None = None
        try:
            import ray

            self._ray: Any = ray
            if address is None:
                local.forget_other_clusters()
                local.protect_token()
                os.environ.update(_LOCAL_SETTINGS)
                self._session = Session(ray, note, stopped, num_cpus=actors, object_store_memory=100 << 20)
            else:
                _connect(ray, address)
        except SessionFailed as error:
            local.restore_variables(self._variables)
            raise FleetFailed(str(error)) from error
        except BaseException:
            local.restore_variables(self._variables)
            raise
        self.deaths = 0
        """Number of workers that died, except those that were lost with their node."""
        self._placement = Placement(actors)
        self._cluster = Cluster(self._ray, self._placement) if address is not None else None
        if address is None:
            self._placement.join(Node("", "127.0.0.1", "", actors or 1))
        self._budget: dict[int, int] = {}
        self._progress_at_death: dict[int, int] = {}
        self.lost: list[str] = []
        """Names of the workers that were lost with their nodes, in the order of detection; they caused no failure."""
        self._running: dict[Any, tuple[int, Any, str]] = {}
        self._undecided: list[EndedWorker] = []
        self._recent_deaths: list[tuple[float, int, str, str]] = []
        """Counted deaths: time, worker number, node identifier, worker name."""
        self._spare: Any = None
        self._lives: dict[int, int] = {}
        self._endpoint = self._run_name = self._certificates = ""
        self._folder: str | None = None
        self._clock = RunningTime()
        self._without_nodes_since: float | None = None
        self.ray_restarts = 0
        """Number of times that Ray was started again on this machine."""
        self._restarts_left, self._progress_at_restart = restarts, -1

    def gather(
        self,
        endpoint: str,
        connect: str,
        certificates: str,
        note: Callable[[str], None],
        stopped: Callable[[], bool],
        needed: Mapping[str, str],
        kernel: bool = False,
    ) -> None:
        """Wait until the cluster's nodes have joined and can reach the learner's endpoint; without a cluster do nothing.

        ``endpoint`` and ``connect`` as in ``config.StreamConfig``, ``needed`` and ``kernel`` as in ``Cluster.require``.
        Returns early once ``stopped()``.  After ``REPORT_MISSING_S`` it reports the missing nodes, and returns if the others
        suffice.
        Raises ConfigError for a node that fails the check, or if there are too few after ``JOIN_S``.
        """
        if self._cluster is None:
            return
        self._cluster.require(endpoint, connect, certificates, needed, kernel)
        began, noted, reported = self._clock(), False, False
        enough_since: float | None = None
        with self._cluster.listening(endpoint, connect):
            while not stopped():
                refused = self._cluster.refresh(note)
                if refused:
                    raise ConfigError("; ".join(refused))
                waited, cores, wanted = self._clock() - began, self._placement.capacity, self._placement.wanted
                all_joined = wanted is not None or not self._cluster.missing_nodes()
                enough = cores >= self._at_least and all_joined and cores >= (wanted or 1)
                enough_since = None if not enough else enough_since or time.monotonic()
                # The port is closed for some seconds after this: running checks should connect before.
                if enough_since and (not self._cluster.undecided or time.monotonic() - enough_since >= CHECKS_S):
                    return
                text = f"the cluster at {self._address} has {cores} cores for {wanted or 'its'} workers"
                if waited >= NOTE_S and not noted:
                    noted = True
                    note(f"{text} so far: waiting for more nodes to join")
                if waited >= REPORT_MISSING_S and not reported:
                    reported = True
                    for line in self._cluster.missing_nodes() or [f"{text}: all nodes of its cluster file have joined"]:
                        note(line)
                if waited >= REPORT_MISSING_S and cores >= self._at_least:
                    note(f"starting with {cores} workers; others start when their nodes join")
                    return
                if waited >= JOIN_S:
                    raise ConfigError(
                        f"{text} after {JOIN_S:.0f} s: ask for fewer with --actors or --min-actors; "
                        "`ray status` lists the nodes"
                    )
                time.sleep(_PAUSE_S)

    def start(self, endpoint: str, run_name: str, folder: Path | None = None, certificates: str = "") -> None:
        """Set the run whose learner listens at ``endpoint``; ``watch`` then launches its workers.

        ``folder``: the run folder, for crash records and stacks if a worker's node has it too.
        ``certificates``: their folder on the workers' nodes, empty without TLS.
        """
        self._endpoint, self._run_name, self._certificates = endpoint, run_name, certificates
        self._folder = str(folder.absolute()) if folder is not None else None
        if self._cluster is not None:
            self._cluster.learner_listens(endpoint)

    def _new_actor(self, cpus: int, node_id: str = "") -> Any:
        where: Any = "SPREAD"
        if node_id:
            where = self._ray.util.scheduling_strategies.NodeAffinitySchedulingStrategy(node_id, soft=False)
        return self._ray.remote(num_cpus=cpus, max_restarts=0, scheduling_strategy=where)(WorkerActor).remote()

    def _name(self, index: int) -> str:
        lives = self._lives.get(index, 0)
        return f"w{index}-{lives}" if lives else f"w{index}"

    def _launch(self, index: int, node_id: str) -> None:
        actor, self._spare = self._spare or self._new_actor(1, node_id), None
        work = actor.work.remote(self._endpoint, self._run_name, self._name(index), self._folder, self._certificates)
        self._running[work] = (index, actor, node_id)

    def watch(self, note: Callable[[str], None], progress: int) -> int:
        """Check the workers once and restart those that died; returns how many are running or will run.

        ``progress`` is any number that grows with the run, such as trajectories stored: if it has grown
        since a worker's last death, that worker has its full budget of restarts again.
        Raises FleetFailed when a worker has died more often than its budget allows, or when there
        has been no node for ``JOIN_S``.
        """
        needed = self._running or self._placement.waiting
        if self._session is not None and needed and (cause := self._session.failure()):
            self._restart_ray(cause, note, progress)
        if self._cluster is not None:
            try:
                if self._cluster.lost():
                    return self._count()
            except ConnectionError as error:
                raise FleetFailed(f"{error}: start the cluster again with `ray up`") from None
            for line in self._cluster.refresh(note):
                note(f"{line}; no worker is placed there")
        elif progress and self._restarts and self._spare is None:
            self._spare = self._new_actor(0)  # only without a cluster: there every process needs a core
        ready, _ = self._ray.wait(list(self._running), num_returns=len(self._running), timeout=0) if self._running else ([], [])
        due = [ended for ended in self._undecided if time.monotonic() >= ended.due]
        self._undecided = [ended for ended in self._undecided if ended not in due]
        for work in ready:
            index, actor, node_id = self._running.pop(work)
            try:
                self._ray.get(work)
            except Exception as error:
                due.append(EndedWorker(index, actor, node_id, error))
            else:
                self._remove_stopped(index)
        for ended in due:
            self._handle_end(ended, note, progress)
        if self._cluster is not None:  # before any launch: every life of a worker has its own name
            self._remove_workers_of_lost_nodes()
        assigned = self._placement.assign()
        for index, node in assigned:
            self._launch(index, node.node_id)
        if assigned and self._cluster is not None:
            note(f"workers: {self._placement.summary(self._name)}")
        self._check_nodes()
        return self._count()

    def _count(self) -> int:
        """Number of workers that are running or will run."""
        return len(self._running) + len(self._undecided) + len(self._placement.waiting)

    def _restart_ray(self, cause: str, note: Callable[[str], None], progress: int) -> None:
        """Start Ray on this machine again, and all workers, whose ends count as those of workers on a lost node.

        Raises FleetFailed if there have been more than ``restarts`` restarts without progress.
        """
        assert self._session is not None
        remedy = f"{cause}; `dmesg` shows whether the kernel killed it for lack of memory"
        if progress > self._progress_at_restart:
            self._restarts_left, self._progress_at_restart = self._restarts, progress
        if self._restarts_left == 0:
            raise FleetFailed(remedy)
        self._restarts_left -= 1
        note(f"{remedy}; starting Ray and its workers again")
        for index, actor, _ in self._running.values():
            self._lost_with_node(index, actor)
        self._running.clear()
        self._undecided.clear()
        self._spare = None
        node = self._placement.nodes[""]
        self._placement.leave("")
        node.workers.clear()
        self._placement.join(node)
        try:
            self._session.restart()
        except SessionFailed as error:
            raise FleetFailed(f"{cause}; {error}") from error
        self.ray_restarts += 1

    def _remove_workers_of_lost_nodes(self) -> None:
        lost = {work: one for work, one in self._running.items() if one[2] not in self._placement.nodes}
        for work, (index, actor, _) in lost.items():
            del self._running[work]
            self._lost_with_node(index, actor)
        for ended in [ended for ended in self._undecided if ended.node_id not in self._placement.nodes]:
            self._undecided.remove(ended)
            self._lost_with_node(ended.index, ended.actor)
        self._recent_deaths = [one for one in self._recent_deaths if time.monotonic() - one[0] < NODE_FAILURE_S]
        for death in list(self._recent_deaths):
            _, index, node_id, name = death
            if node_id not in self._placement.nodes:
                self._recent_deaths.remove(death)  # a node that shuts down ends its workers before Ray's own process
                self.lost.append(name)
                self.deaths -= 1
                self._budget[index] = min(self._restarts, self._budget[index] + 1)

    def _lost_with_node(self, index: int, actor: Any) -> None:
        """Record a worker that was lost with its node; this costs it no restart."""
        self.lost.append(self._name(index))
        self._lives[index] = self._lives.get(index, 0) + 1
        self._kill(actor)  # it may still run, disconnected

    def _kill(self, actor: Any) -> None:
        with contextlib.suppress(Exception):
            self._ray.kill(actor)

    def _remove_stopped(self, index: int) -> None:
        """Remove a worker that the learner stopped, together with its core: no other worker is to start there."""
        if (node := self._placement.node_of(index)) is not None:
            node.workers.discard(index)
            node.cores -= 1

    def _handle_end(self, ended: EndedWorker, note: Callable[[str], None], progress: int) -> None:
        """Find out whether a worker died by itself, which costs a restart, or with its node, and restart it.

        Ray lists a node as alive for 15 s and longer after its end, but reports a broken connection at
        once: while the node cannot be reached, the decision is postponed.
        """
        index, actor, node_id, error = ended.index, ended.actor, ended.node_id, ended.error
        if self._cluster is not None:
            if self._cluster.node_lost(node_id, note):
                self._lost_with_node(index, actor)
                return
            if isinstance(error, self._ray.exceptions.RayActorError) and not self._cluster.reachable(node_id):
                self._undecided.append(EndedWorker(index, actor, node_id, error, time.monotonic() + RECHECK_S))
                return
            self._kill(actor)  # it may still run, and nothing would detect its end
            self._recent_deaths.append((time.monotonic(), index, node_id, self._name(index)))
        self._lives[index] = self._lives.get(index, 0) + 1
        self.deaths += 1
        cause = brief(error)
        if progress > self._progress_at_death.get(index, -1):
            self._budget[index] = self._restarts
        self._progress_at_death[index] = progress
        if self._budget.setdefault(index, self._restarts) == 0:
            times = self._restarts + 1
            raise FleetFailed(f"worker w{index} died {times} times without progress; last: {cause}") from None
        self._budget[index] -= 1
        note(f"worker w{index} died ({cause}); starting it again")
        if self._placement.node_of(index) is not None:
            self._launch(index, node_id)
        else:
            self._placement.waiting.append(index)

    def _check_nodes(self) -> None:
        """Raises FleetFailed if there has been no node for ``JOIN_S``."""
        if self._cluster is None or self._placement.nodes:
            self._without_nodes_since = None
        elif self._without_nodes_since is None:
            self._without_nodes_since = self._clock()
        elif self._clock() - self._without_nodes_since > JOIN_S:
            raise FleetFailed(f"no node has been available for {JOIN_S:.0f} s; `ray status` shows why")

    def close(self) -> None:
        """End all workers, and Ray if it was started here."""
        if self._session is not None:
            self._session.close()
        else:
            for _, actor, _ in self._running.values():
                self._kill(actor)
            self._ray.shutdown()
        self._running.clear()
        local.restore_variables(self._variables)


@contextlib.contextmanager
def connected(address: str) -> Iterator[Any]:
    """The module ``ray``, connected to the cluster at ``address`` within this context.  Raises ConfigError if there is none."""
    local.refuse_running_session()
    variables = local.variables()
    os.environ.update(_SETTINGS)
    try:
        import ray

        _connect(ray, address)
        try:
            yield ray
        finally:
            ray.shutdown()
    finally:
        local.restore_variables(variables)


def _connect(ray: Any, address: str) -> None:
    """Connect to the cluster at ``address``.  Raises ConfigError if there is none."""
    require_cluster(address)
    try:
        with sigterm_unchanged(ray):
            ray.init(address=address, job_config=ray_job.job_config(ray), log_to_driver=False, logging_level=logging.ERROR)
    except (ConnectionError, ValueError, RuntimeError, ray.exceptions.AuthenticationError) as error:
        raise ConfigError(f"--address {address}: {brief(error)}; `ray status` there shows whether a cluster is up") from None
