"""The nodes of a Ray cluster: which have joined, which can run workers, and which have left.

Ray is an argument: only ``fleet`` imports it.
"""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any

from actors import missing
from actors.placement import Node, Placement
from actors.running_time import RunningTime
from icrl_dist.config.run import ConfigError
from icrl_dist.diagnostics import node_facts
from icrl_dist.stream import endpoints

REFRESH_S = 1.0
"""Seconds between two requests to Ray for its list of nodes."""
ANSWER_S = 60.0
"""Seconds after which a node that has not answered is refused; Ray needs seconds to start a process."""
RETRY_S = 2.0
"""Seconds before the first repeated check of a node that was refused; they double up to ``_MAX_RETRY_S``."""
_MAX_RETRY_S = 60.0
TRIES = 3
"""A node on which Ray fails this often before a run starts, although it can be reached, is refused."""
HEAD_S = 30.0
"""Seconds after which a cluster whose head cannot be reached is lost; Ray aborts this process after 60 s."""
UNREACHED_S = 5.0
"""Seconds before a node that could not be reached is tried again."""
_EXAMPLE = "--stream.endpoint tls/HEAD_IP:7447 --stream.certificates FOLDER"


@dataclass(eq=False)
class _Candidate:
    """A node that has joined the cluster and has not passed the check yet."""

    node: Node
    due: float = 0.0
    """Time of the next check."""
    since: float = 0.0
    """Time of the last check, in seconds for which this process ran."""
    tries: int = 0
    reported: str = ""
    """The last reported reason for which the node is refused."""


class Cluster:
    """Checks the nodes of a Ray cluster and keeps a Placement up to date with those that pass."""

    def __init__(self, ray: Any, placement: Placement) -> None:
        self._ray, self._placement = ray, placement
        self._expected = missing.expected()
        self._candidates: dict[str, _Candidate] = {}
        """Nodes that have joined and have not passed the check yet, by Ray's identifier."""
        self._running_checks: dict[Any, _Candidate] = {}
        self._seen: set[str] = set()
        """Nodes that are or were candidates, whatever the result."""
        self._unreached: dict[str, float] = {}
        """When a node could not be reached, the last time."""
        self._before_run = False
        self._refreshed = -REFRESH_S
        self._certificates = ""
        self._needed: Mapping[str, str] = {}
        self._kernel = False
        self._ports: list[tuple[str, int]] = []
        self._head: str = ray.get_runtime_context().gcs_address
        self._unanswered = ""
        self._clock = RunningTime()
        self._probed = self._head_answered = self._clock()
        self._own_facts = node_facts.facts()
        self._loopback = ""

    def require(self, endpoint: str, connect: str, certificates: str, needed: Mapping[str, str], kernel: bool = False) -> None:
        """Set what a node must reach and have: the learner at ``connect`` or else ``endpoint``, and the certificates.

        ``needed``: the run's problem and method, from ``plugins.of_run``; a node must have them from the same package.
        ``kernel``: whether it needs the compiled decoder.
        """
        self._certificates, self._needed, self._kernel = certificates, needed, kernel
        where = endpoints.parse(connect or endpoint)
        self._loopback = connect or endpoint if where.loopback else ""
        self._ports = [(where.host, where.port)]

    @contextlib.contextmanager
    def listening(self, endpoint: str, connect: str) -> Iterator[None]:
        """Listen at the learner's endpoint before the learner starts, so that nodes can check the connection.

        Raises ConfigError if that is impossible.
        """
        where = endpoints.parse(endpoint)
        try:
            with node_facts.listening(where.host, where.port) as port:
                if not connect:
                    self._ports = [(where.host, port)]
                self._before_run = True
                yield
        except OSError as error:
            raise ConfigError(
                f"stream.endpoint = {endpoint!r}: cannot be listened on ({error.strerror or error}); "
                "name an address of this machine and a free port"
            ) from None
        finally:
            self._before_run = False

    def learner_listens(self, endpoint: str) -> None:
        """Set the endpoint of the running learner, which nodes that join later must reach."""
        where = endpoints.parse(endpoint)
        self._ports = [(where.host, where.port)]

    @property
    def undecided(self) -> bool:
        """Whether a node that has joined has not passed the check yet."""
        return bool(self._candidates)

    def refresh(self, note: Callable[[str], None]) -> list[str]:
        """Update the placement; returns a new line for each node that is refused.

        Raises ConfigError within ``listening`` if there are nodes that cannot reach this one.
        """
        refused = self._refresh_nodes(note) if time.monotonic() - self._refreshed >= REFRESH_S else []
        for candidate in self._candidates.values():
            if candidate not in self._running_checks.values() and time.monotonic() >= candidate.due:
                self._start_check(candidate)
        return [*refused, *self._finish_checks()]

    def lost(self) -> str:
        """Why Ray must not be called now: its head cannot be reached, so a call would not return; empty if it can.

        Raises ConnectionError after ``HEAD_S``.
        """
        now = self._clock()
        if now - self._probed >= REFRESH_S:
            self._probed = now
            host, _, port = self._head.rpartition(":")
            self._unanswered = node_facts.reach(host.strip("[]"), int(port), timeout_s=1.0)
            if not self._unanswered:
                self._head_answered = now
        if now - self._head_answered >= HEAD_S:
            raise ConnectionError(f"the cluster's head has not answered for {HEAD_S:.0f} s ({self._unanswered})")
        return self._unanswered

    def _alive(self) -> dict[str, dict[str, Any]]:
        """The nodes that Ray lists as alive, by identifier."""
        return {str(node["NodeID"]): node for node in self._ray.nodes() if node["Alive"]}

    def _refresh_nodes(self, note: Callable[[str], None]) -> list[str]:
        """Add and remove nodes as Ray lists them; returns a line for each new node that cannot be used."""
        self._refreshed = time.monotonic()
        alive = self._alive()
        for node_id in set(self._placement.nodes) - set(alive):
            self._remove(node_id, note)
        self._seen &= set(alive)
        self._candidates = {node_id: one for node_id, one in self._candidates.items() if node_id in alive}
        self._running_checks = {check: one for check, one in self._running_checks.items() if one.node.node_id in alive}
        remedy = (
            f"stream.endpoint = {self._loopback!r}: other nodes cannot reach it; "
            f"name an address of this machine, as in {_EXAMPLE}"
        )
        if self._loopback and self._before_run and len(alive) > 1:
            raise ConfigError(remedy)
        new = {n: ray_node for n, ray_node in alive.items() if n not in self._seen and _cores(ray_node) >= 1}
        self._seen |= set(new)
        nodes = [Node(n, str(ray_node["NodeManagerAddress"]), "", _cores(ray_node)) for n, ray_node in new.items()]
        if self._loopback and not self._before_run:
            return [f"{node}: {remedy}" for node in nodes]
        self._candidates.update({node.node_id: _Candidate(node) for node in nodes})
        return []

    def _start_check(self, candidate: _Candidate) -> None:
        strategy = self._ray.util.scheduling_strategies.NodeAffinitySchedulingStrategy(candidate.node.node_id, soft=False)
        task = self._ray.remote(num_cpus=0, max_retries=0, scheduling_strategy=strategy)(node_facts.facts)
        candidate.since, candidate.tries = self._clock(), candidate.tries + 1
        self._running_checks[task.remote(self._certificates, self._ports)] = candidate

    def _finish_checks(self) -> list[str]:
        refused: list[str] = []
        checks = list(self._running_checks)
        ready, _ = self._ray.wait(checks, num_returns=len(checks), timeout=0) if checks else ([], [])
        for check in ready:
            candidate = self._running_checks.pop(check)
            node = candidate.node
            try:
                facts = self._ray.get(check)
            except Exception as error:
                text = f"{node}: {brief(error)}; run `ray up` again, so that it has this version of icrl-dist"
                # A RayTaskError was raised by the node's own code; other errors may come from a process or node that ended.
                final = isinstance(error, self._ray.exceptions.RayTaskError)
                refused += self._refuse(candidate, text, retry=not final, certain=final or self._tried_enough(candidate))
                continue
            node.hostname = facts["host"]
            if differing := node_facts.differences(self._own_facts, facts, self._needed):
                remedy = "run `ray up` again, so that all nodes have the same"
                refused += self._refuse(candidate, f"{node}: {', '.join(differing)}: {remedy}", retry=False)
            elif self._kernel and facts["decoder"]:
                refused += self._refuse(candidate, f"{node}: context.decoder = 'kernel': {facts['decoder']}", retry=False)
            elif problem := connection_problems(facts):
                refused += self._refuse(candidate, f"{node}: {problem}")
            else:
                del self._candidates[node.node_id]
                self._placement.join(node)
        for check, candidate in list(self._running_checks.items()):
            if self._clock() - candidate.since > ANSWER_S:
                del self._running_checks[check]
                text = f"{candidate.node}: has not answered for {ANSWER_S:.0f} s; look at /tmp/ray/session_latest/logs there"
                refused += self._refuse(candidate, text, certain=self.reachable(candidate.node.node_id))
        return refused

    def _refuse(self, candidate: _Candidate, why: str, retry: bool = True, certain: bool = True) -> list[str]:
        """Record that a node cannot run workers now; returns the lines to report.

        ``retry``: whether to check it again.  ``certain``: whether this prevents the start of a run.  While a run is on,
        a reason is reported once, and one that may disappear by itself only after ``TRIES`` checks.
        """
        if retry:
            candidate.due = time.monotonic() + min(RETRY_S * 2.0 ** (candidate.tries - 1), _MAX_RETRY_S)
        else:
            del self._candidates[candidate.node.node_id]
        if self._before_run:
            return [why] if certain else []
        if why == candidate.reported or (retry and candidate.tries < TRIES):  # the learner may be about to start
            return []
        candidate.reported = why
        return [why]

    def _tried_enough(self, candidate: _Candidate) -> bool:
        return candidate.tries >= TRIES and self.reachable(candidate.node.node_id)

    def reachable(self, node_id: str) -> bool:
        """Whether Ray's node process can be reached now; Ray itself needs up to a minute to report that it cannot.

        A node that was not reached is not tried again for ``UNREACHED_S``.
        """
        if time.monotonic() - self._unreached.get(node_id, -UNREACHED_S) < UNREACHED_S:
            return False
        node = self._alive().get(node_id)
        if node and not node_facts.reach(str(node["NodeManagerAddress"]), int(node["NodeManagerPort"]), timeout_s=1.0):
            return True
        self._unreached[node_id] = time.monotonic()
        return False

    def node_lost(self, node_id: str, note: Callable[[str], None]) -> bool:
        """Whether a node has left the cluster; if so it is removed from the placement."""
        if node_id in self._alive():
            return False
        self._remove(node_id, note)
        return True

    def _remove(self, node_id: str, note: Callable[[str], None]) -> None:
        node = self._placement.nodes.get(node_id)
        lost = self._placement.leave(node_id)
        if node is not None:
            note(f"node {node} has left; its {len(lost)} workers start on other nodes with free cores, or wait for one")

    def missing_nodes(self) -> list[str]:
        """One line per node that the cluster file promises and that has not joined."""
        return missing.report(self._expected, {node.address for node in self._placement.nodes.values()})


def _cores(ray_node: dict[str, Any]) -> int:
    return int(ray_node.get("Resources", {}).get("CPU") or 0)


def connection_problems(facts: dict[str, Any]) -> str:
    """What prevents a node from reaching the learner, with the remedy; empty if nothing does."""
    found = [str(facts["certificates"])] if facts["certificates"] else []
    if facts["unreached"]:
        found.append(
            f"cannot reach the learner's port, {facts['unreached'][0]}: open it in the firewall, or see stream.connect"
        )
    return "; ".join(found)


def brief(error: BaseException) -> str:
    """The last line of an error's message; of the end of a worker only how it ended, without Ray's advice."""
    lines = [line for line in str(error).splitlines() if line.strip()]
    last = lines[-1].rpartition("Worker exit detail: ")[2].partition(" Some common causes")[0].strip() if lines else ""
    return last[:200] or type(error).__name__
