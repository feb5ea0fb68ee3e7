"""The machines of a Ray cluster: which are here, whether each is fit, and which have gone.

Ray comes as an argument: only ``fleet`` imports it.
"""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable, Iterator
from typing import Any

from actors import missing
from actors.placement import Machine, Placement
from icrl_dist import endpoints, nodes
from icrl_dist.config import ConfigError

LOOK_S = 1.0
"""Ray is asked for its machines so often."""
ANSWER_S = 60.0
"""A machine that has not answered after so long does not fit: a process of Ray's takes seconds to start."""


class Cluster:
    """Keeps a Placement true to what Ray says of its machines."""

    def __init__(self, ray: Any, placement: Placement) -> None:
        self._ray, self._placement = ray, placement
        self._promised = missing.expected()
        self._asked: dict[Any, tuple[Machine, float]] = {}
        self._known: set[str] = set()
        """Machines that were asked, whatever came of it."""
        self._looked = -LOOK_S
        self._certificates = ""
        self._ports: list[tuple[str, int]] = []
        self._here = nodes.facts()
        self._loopback = ""

    def look_for(self, endpoint: str, connect: str, certificates: str) -> None:
        """What machines must have and reach: the learner at ``connect`` or ``endpoint``, and certificates."""
        self._certificates = certificates
        where = endpoints.parse(connect or endpoint)
        self._loopback = connect or endpoint if where.loopback else ""
        self._ports = [(where.host, where.port)]

    @contextlib.contextmanager
    def listening(self, endpoint: str, connect: str) -> Iterator[None]:
        """Somebody stands where the learner will listen, so that machines can try to reach it.

        Raises ConfigError if nobody can.
        """
        where = endpoints.parse(endpoint)
        try:
            with nodes.listening(where.host, where.port) as port:
                if not connect:
                    self._ports = [(where.host, port)]
                yield
        except OSError as error:
            raise ConfigError(
                f"stream.endpoint = {endpoint!r}: cannot be listened on ({error.strerror or error}); "
                "name an address of this machine and a free port"
            ) from None

    def listens(self, endpoint: str) -> None:
        """The learner does now; machines that join later must reach it there."""
        where = endpoints.parse(endpoint)
        self._ports = [(where.host, where.port)]

    def refresh(self, note: Callable[[str], None]) -> list[str]:
        """Take in what changed since the last call; returns why each new machine that does not fit does not."""
        if time.monotonic() - self._looked >= LOOK_S:
            self._looked = time.monotonic()
            alive = {node["NodeID"]: node for node in self._ray.nodes() if node["Alive"]}
            for gone in set(self._placement.machines) - set(alive):
                self._gone(gone, note)
            self._known &= set(alive)
            workers = {name: node for name, node in alive.items() if node.get("Resources", {}).get("CPU", 0) >= 1}
            if self._loopback and len(alive) > 1:
                raise ConfigError(
                    f"stream.endpoint = {self._loopback!r}: other machines cannot reach it; name an address of this one, "
                    "as in --stream.endpoint tls/HEAD_IP:7447 --stream.certificates FOLDER"
                )
            for name, node in workers.items():
                if name not in self._known:
                    self._known.add(name)
                    self._ask(Machine(name, str(node["NodeManagerAddress"]), "", int(node["Resources"]["CPU"])))
        return self._answers()

    def _ask(self, machine: Machine) -> None:
        where = self._ray.util.scheduling_strategies.NodeAffinitySchedulingStrategy(machine.node, soft=False)
        task = self._ray.remote(num_cpus=0, max_retries=0, scheduling_strategy=where)(nodes.facts)
        self._asked[task.remote(self._certificates, self._ports)] = (machine, time.monotonic())

    def _answers(self) -> list[str]:
        unfit = []
        ready, _ = self._ray.wait(list(self._asked), num_returns=len(self._asked), timeout=0) if self._asked else ([], [])
        for answer in ready:
            machine, _ = self._asked.pop(answer)
            try:
                facts = self._ray.get(answer)
            except Exception as error:
                unfit.append(f"{machine}: {brief(error)}; run `ray up` again, so that it has this version of icrl-dist")
                continue
            machine.host = facts["host"]
            wrong = objections(self._here, facts)
            if wrong:
                unfit.append(f"{machine}: {wrong}")
            else:
                self._placement.join(machine)
        for answer, (machine, since) in list(self._asked.items()):
            if time.monotonic() - since > ANSWER_S:
                del self._asked[answer]
                unfit.append(f"{machine}: has not answered for {ANSWER_S:.0f} s; look at /tmp/ray/session_latest/logs there")
        return unfit

    def lost(self, node: str, note: Callable[[str], None]) -> bool:
        """Whether a worker ended because its machine did; its place is given up then."""
        if any(one["NodeID"] == node and one["Alive"] for one in self._ray.nodes()):
            return False
        self._gone(node, note)
        return True

    def _gone(self, node: str, note: Callable[[str], None]) -> None:
        machine = self._placement.machines.get(node)
        lost = self._placement.leave(node)
        if machine is not None:
            note(f"machine {machine} is gone; its {len(lost)} workers go where there is room, or wait until it is back")

    def absent(self) -> list[str]:
        """A line for each machine that the cluster file promises and that is not here."""
        return missing.report(self._promised, {machine.address for machine in self._placement.machines.values()})


def objections(here: dict[str, Any], there: dict[str, Any]) -> str:
    """Why a machine cannot work for this one, with the remedy; empty if it can."""
    wrong = nodes.differences(here, there)
    if wrong:
        return f"{', '.join(wrong)}: run `ray up` again, so that all machines have the same"
    unfit = [str(there["certificates"])] if there["certificates"] else []
    if there["unreached"]:
        unfit.append(
            f"cannot reach the learner's port, {there['unreached'][0]}: open it in the firewall, or see stream.connect"
        )
    return "; ".join(unfit)


def brief(error: BaseException) -> str:
    """The last line of what Ray says of an error."""
    lines = [line for line in str(error).splitlines() if line.strip()]
    return lines[-1].strip()[:200] if lines else type(error).__name__
