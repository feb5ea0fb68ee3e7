"""The doctor's questions to every machine of a cluster that is up; Ray comes as an argument."""

from __future__ import annotations

import time
from collections.abc import Iterator
from typing import Any

from icrl_dist.diagnostics import node_facts
from icrl_dist.diagnostics.checks import Finding

_PORTS = ("NodeManagerPort", "ObjectManagerPort")
"""Where Ray's machines talk to each other, as ``ray.nodes`` names them."""
_ANSWER_S = 60.0
_GIB = 1 << 30


def examine(ray: Any, learner: tuple[str, int] | None, certificates: str) -> list[Finding]:
    """What every machine answers; somebody listens at ``learner`` now, for them to reach, unless that is None."""
    found = [node for node in ray.nodes() if node["Alive"]]
    return [finding for node in found for finding in _machine(ray, node, found, learner, certificates)]


def _machine(
    ray: Any, node: dict[str, Any], machines: list[dict[str, Any]], learner: tuple[str, int] | None, certificates: str
) -> Iterator[Finding]:
    """What one machine answers, or that it does not."""
    address = str(node["NodeManagerAddress"])
    others = [one for one in machines if one is not node]
    ports = [(str(one["NodeManagerAddress"]), int(one[kind])) for one in others for kind in _PORTS]
    gcs = ray.get_runtime_context().gcs_address.rpartition(":")
    where = ray.util.scheduling_strategies.NodeAffinitySchedulingStrategy(node["NodeID"], soft=False)
    asked = ray.remote(num_cpus=0, max_retries=0, scheduling_strategy=where)(node_facts.facts)
    began = time.time()
    try:
        ray.get(asked.remote(), timeout=_ANSWER_S)  # a new process of Ray's takes seconds, so the clock is asked next
        began = time.time()
        there = ray.get(
            asked.remote(certificates, [*filter(None, [learner]), (gcs[0], int(gcs[2])), *ports]), timeout=_ANSWER_S
        )
    except Exception as error:
        said = (str(error).strip().splitlines() or [type(error).__name__])[-1]
        yield Finding(
            address, False, f"does not answer: {said}", "run `ray up` again, or look at its /tmp/ray/session_latest/logs"
        )
        return
    name = f"{there['host']} ({address})"
    wrong = node_facts.differences(node_facts.facts(), there)
    remedy = "run `ray up` again, so that all machines have the same"
    yield Finding(
        f"{name} versions", not wrong, ", ".join(wrong) or f"icrl-dist {there['code'][:8]}, as here", remedy if wrong else ""
    )
    skew = max(0.0, began - there["time"], there["time"] - time.time())
    clock = True if skew < 1 else None if skew < 60 else False
    yield Finding(
        f"{name} clock", clock, f"{skew:.1f} s off", "" if clock else "run ntpd or chronyd: certificates depend on it"
    )
    yield _shared_memory_of(name, int(there["shared_memory"]))
    files = True if there["open_files"] >= 4096 else None
    yield Finding(
        f"{name} open files", files, f"at most {there['open_files']}", "" if files else "ulimit -n 65536 before ray start"
    )
    if node["Resources"].get("CPU", 0) and certificates:
        bad = str(there["certificates"])
        yield Finding(f"{name} certificates", not bad, bad or "worker's, readable", "see docs/security.md" if bad else "")
    yield from (
        Finding(f"{name} ports", False, said, "open it between the machines of the cluster") for said in there["unreached"]
    )
    if not there["unreached"]:
        whose = "the learner's, Ray's" if learner else "Ray's"
        yield Finding(f"{name} ports", True, f"reaches {whose} and {len(ports)} of the other machines")


def _shared_memory_of(name: str, free: int) -> Finding:
    enough = True if free >= 0.5 * _GIB else None
    remedy = "mount -o remount,size=2G /dev/shm, or the container's --shm-size=2g"
    return Finding(f"{name} shared memory", enough, f"{free / _GIB:.1f} GiB free", "" if enough else remedy)
