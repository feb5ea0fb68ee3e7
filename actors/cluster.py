"""The machines of a Ray cluster: which are here, whether each is fit, and which have gone.

Ray comes as an argument: only ``fleet`` imports it.
"""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

from actors import missing
from actors.placement import Machine, Placement
from icrl_dist.config.run import ConfigError
from icrl_dist.diagnostics import node_facts
from icrl_dist.stream import endpoints

LOOK_S = 1.0
"""Ray is asked for its machines so often."""
ANSWER_S = 60.0
"""A machine that has not answered after so long does not fit: a process of Ray's takes seconds to start."""
AGAIN_S = 2.0
"""A machine that does not fit is asked again after so long, then twice as long, and so on up to ``_SELDOM_S``."""
_SELDOM_S = 60.0
TRIES = 3
"""A machine on which Ray fails so often before a run begins, though it answers, does not fit."""
SILENT_S = 5.0
"""A machine that did not answer is not tried again for so long."""
_AS_IN = "--stream.endpoint tls/HEAD_IP:7447 --stream.certificates FOLDER"


@dataclass(eq=False)
class _Candidate:
    """A machine that may become one of ours."""

    machine: Machine
    due: float = 0.0
    """When it is to be asked."""
    since: float = 0.0
    """When it was asked last."""
    tries: int = 0
    told: str = ""
    """Why it does not fit, as it was said last."""


class Cluster:
    """Keeps a Placement true to what Ray says of its machines."""

    def __init__(self, ray: Any, placement: Placement) -> None:
        self._ray, self._placement = ray, placement
        self._promised = missing.expected()
        self._candidates: dict[str, _Candidate] = {}
        """Machines that are here and have not yet said that they are fit."""
        self._asked: dict[Any, _Candidate] = {}
        self._known: set[str] = set()
        """Machines that are or were candidates, whatever came of it."""
        self._silent: dict[str, float] = {}
        """When a machine did not answer, the last time."""
        self._gathering = False
        self._looked = -LOOK_S
        self._certificates = ""
        self._ports: list[tuple[str, int]] = []
        self._here = node_facts.facts()
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
            with node_facts.listening(where.host, where.port) as port:
                if not connect:
                    self._ports = [(where.host, port)]
                self._gathering = True
                yield
        except OSError as error:
            raise ConfigError(
                f"stream.endpoint = {endpoint!r}: cannot be listened on ({error.strerror or error}); "
                "name an address of this machine and a free port"
            ) from None
        finally:
            self._gathering = False

    def listens(self, endpoint: str) -> None:
        """The learner does now; machines that join later must reach it there."""
        where = endpoints.parse(endpoint)
        self._ports = [(where.host, where.port)]

    @property
    def undecided(self) -> bool:
        """Whether a machine that is here has yet to say that it is fit."""
        return bool(self._candidates)

    def refresh(self, note: Callable[[str], None]) -> list[str]:
        """Take in what changed since the last call; returns why each machine that does not fit does not, once.

        Raises ConfigError within ``listening`` if there are machines that cannot reach this one.
        """
        unfit = self._look(note) if time.monotonic() - self._looked >= LOOK_S else []
        for one in self._candidates.values():
            if one not in self._asked.values() and time.monotonic() >= one.due:
                self._ask(one)
        return [*unfit, *self._answers()]

    def _alive(self) -> dict[str, dict[str, Any]]:
        """Ray's machines, by name, as far as Ray knows."""
        return {str(node["NodeID"]): node for node in self._ray.nodes() if node["Alive"]}

    def _look(self, note: Callable[[str], None]) -> list[str]:
        """Who is here; returns what is to be said of those that have come in vain."""
        self._looked = time.monotonic()
        alive = self._alive()
        for gone in set(self._placement.machines) - set(alive):
            self._gone(gone, note)
        self._known &= set(alive)
        self._candidates = {name: one for name, one in self._candidates.items() if name in alive}
        self._asked = {answer: one for answer, one in self._asked.items() if one.machine.node in alive}
        remedy = (
            f"stream.endpoint = {self._loopback!r}: other machines cannot reach it; name an address of this one, as in {_AS_IN}"
        )
        if self._loopback and self._gathering and len(alive) > 1:
            raise ConfigError(remedy)
        new = {n: node for n, node in alive.items() if n not in self._known and node.get("Resources", {}).get("CPU", 0) >= 1}
        self._known |= set(new)
        made = [Machine(n, str(node["NodeManagerAddress"]), "", int(node["Resources"]["CPU"])) for n, node in new.items()]
        if self._loopback and not self._gathering:
            return [f"{machine}: {remedy}" for machine in made]
        self._candidates.update({machine.node: _Candidate(machine) for machine in made})
        return []

    def _ask(self, one: _Candidate) -> None:
        where = self._ray.util.scheduling_strategies.NodeAffinitySchedulingStrategy(one.machine.node, soft=False)
        task = self._ray.remote(num_cpus=0, max_retries=0, scheduling_strategy=where)(node_facts.facts)
        one.since, one.tries = time.monotonic(), one.tries + 1
        self._asked[task.remote(self._certificates, self._ports)] = one

    def _answers(self) -> list[str]:
        unfit: list[str] = []
        ready, _ = self._ray.wait(list(self._asked), num_returns=len(self._asked), timeout=0) if self._asked else ([], [])
        for answer in ready:
            one = self._asked.pop(answer)
            machine = one.machine
            try:
                facts = self._ray.get(answer)
            except Exception as error:
                said = f"{machine}: {brief(error)}; run `ray up` again, so that it has this version of icrl-dist"
                # What its own code raised is its word; anything else may be Ray's, of a process or a machine that ended.
                final = isinstance(error, self._ray.exceptions.RayTaskError)
                unfit += self._unfit(one, said, asked_again=not final, refused=final or self._tried_enough(one))
                continue
            machine.host = facts["host"]
            if differing := node_facts.differences(self._here, facts):
                remedy = "run `ray up` again, so that all machines have the same"
                unfit += self._unfit(one, f"{machine}: {', '.join(differing)}: {remedy}", asked_again=False)
            elif wrong := objections(facts):
                unfit += self._unfit(one, f"{machine}: {wrong}")
            else:
                del self._candidates[machine.node]
                self._placement.join(machine)
        for answer, one in list(self._asked.items()):
            if time.monotonic() - one.since > ANSWER_S:
                del self._asked[answer]
                silent = f"{one.machine}: has not answered for {ANSWER_S:.0f} s; look at /tmp/ray/session_latest/logs there"
                unfit += self._unfit(one, silent, refused=self.answers(one.machine.node))
        return unfit

    def _unfit(self, one: _Candidate, why: str, asked_again: bool = True, refused: bool = True) -> list[str]:
        """A machine cannot work as it is; returns what there is to say of it now.

        ``refused``: whether that is a reason not to begin; later it is said once, and nothing that may pass by itself.
        """
        if asked_again:
            one.due = time.monotonic() + min(AGAIN_S * 2.0 ** (one.tries - 1), _SELDOM_S)
        else:
            del self._candidates[one.machine.node]
        if self._gathering:
            return [why] if refused else []
        if why == one.told or (asked_again and one.tries < TRIES):  # the learner may be just starting
            return []
        one.told = why
        return [why]

    def _tried_enough(self, one: _Candidate) -> bool:
        return one.tries >= TRIES and self.answers(one.machine.node)

    def answers(self, node: str) -> bool:
        """Whether Ray's own process on a machine can be reached now; Ray itself takes up to a minute to say so.

        A machine that did not answer is not tried again for a while.
        """
        if time.monotonic() - self._silent.get(node, -SILENT_S) < SILENT_S:
            return False
        there = self._alive().get(node)
        if there and not node_facts.reach(str(there["NodeManagerAddress"]), int(there["NodeManagerPort"]), timeout_s=1.0):
            return True
        self._silent[node] = time.monotonic()
        return False

    def lost(self, node: str, note: Callable[[str], None]) -> bool:
        """Whether a worker ended because its machine did; its place is given up then."""
        if node in self._alive():
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


def objections(there: dict[str, Any]) -> str:
    """What a machine lacks to reach the learner, with the remedy; empty if nothing."""
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
