"""The doctor's checks of every node of a running cluster; the module ``ray`` is an argument."""

from __future__ import annotations

import time
from collections.abc import Iterator
from typing import Any

from icrl_dist.diagnostics import node_facts
from icrl_dist.diagnostics.checks import Check

_PORTS = ("NodeManagerPort", "ObjectManagerPort")
"""Ports between Ray's nodes, by their keys in ``ray.nodes()``."""
_ANSWER_S = 60.0
"""Seconds to wait for the answer of a node."""
_GIB = 1 << 30


def check_nodes(ray: Any, learner: tuple[str, int] | None, certificates: str) -> list[Check]:
    """The checks of every node; ``learner``: host and port that each must reach, where a socket listens now, or None."""
    nodes = [node for node in ray.nodes() if node["Alive"]]
    return [check for node in nodes for check in _check_node(ray, node, nodes, learner, certificates)]


def _check_node(
    ray: Any, node: dict[str, Any], nodes: list[dict[str, Any]], learner: tuple[str, int] | None, certificates: str
) -> Iterator[Check]:
    """The checks of one node, or one failed check if it does not answer."""
    address = str(node["NodeManagerAddress"])
    others = [other for other in nodes if other is not node]
    ports = [(str(other["NodeManagerAddress"]), int(other[port])) for other in others for port in _PORTS]
    gcs = ray.get_runtime_context().gcs_address.rpartition(":")
    placement = ray.util.scheduling_strategies.NodeAffinitySchedulingStrategy(node["NodeID"], soft=False)
    remote_facts = ray.remote(num_cpus=0, max_retries=0, scheduling_strategy=placement)(node_facts.facts)
    try:
        ray.get(remote_facts.remote(), timeout=_ANSWER_S)  # Ray starts a process, which takes seconds: the clock is read next
        asked_at = time.time()
        facts = ray.get(
            remote_facts.remote(certificates, [*filter(None, [learner]), (gcs[0], int(gcs[2])), *ports]), timeout=_ANSWER_S
        )
    except Exception as error:
        reason = (str(error).strip().splitlines() or [type(error).__name__])[-1]
        yield Check(
            address, False, f"does not answer: {reason}", "run `ray up` again, or read /tmp/ray/session_latest/logs there"
        )
        return
    name = f"{facts['host']} ({address})"
    here = node_facts.facts()
    wrong = node_facts.differences(here, facts)
    remedy = "run `ray up` again, so that all nodes have the same versions"
    yield Check(
        f"{name} versions", not wrong, ", ".join(wrong) or f"icrl-dist {facts['code'][:8]}, as here", remedy if wrong else ""
    )
    if not wrong and facts["decoder"] and not here["decoder"]:  # runs that begin here need it
        yield Check(f"{name} decoder", False, facts["decoder"], "or begin runs with --context.decoder torch")
    skew = max(0.0, asked_at - facts["time"], facts["time"] - time.time())
    clock = True if skew < 1 else None if skew < 60 else False
    yield Check(
        f"{name} clock", clock, f"{skew:.1f} s off", "" if clock else "run ntpd or chronyd: certificates need the right time"
    )
    yield _shared_memory_of(name, int(facts["shared_memory"]))
    files = True if facts["open_files"] >= 4096 else None
    yield Check(
        f"{name} open files", files, f"at most {facts['open_files']}", "" if files else "ulimit -n 65536 before ray start"
    )
    if node["Resources"].get("CPU", 0) and certificates:
        bad = str(facts["certificates"])
        yield Check(
            f"{name} certificates", not bad, bad or "the worker's files are readable", "see docs/security.md" if bad else ""
        )
    yield from (
        Check(f"{name} ports", False, reason, "open it between the nodes of the cluster") for reason in facts["unreached"]
    )
    if not facts["unreached"]:
        first = "the learner's, Ray's" if learner else "Ray's"
        yield Check(f"{name} ports", True, f"reaches {first} and {len(ports)} of the other nodes")


def _shared_memory_of(name: str, free: int) -> Check:
    enough = True if free >= 0.5 * _GIB else None
    remedy = "mount -o remount,size=2G /dev/shm, or the container's --shm-size=2g"
    return Check(f"{name} shared memory", enough, f"{free / _GIB:.1f} GiB free", "" if enough else remedy)
