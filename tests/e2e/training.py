"""Helpers for complete runs in tests: start them, wait for a moment, compare their results."""

import contextlib
import json
import subprocess
import sys
import threading
import time

import psutil

from icrl_dist.stream import monitor_messages, wire
from icrl_dist.stream.zenoh_link import ZenohLink
from icrl_dist.telemetry import processes

CLI = [sys.executable, "-m", "icrl_dist.cli"]
# Both of smoke's rounds, with fewer trajectories in each, and a first fit of about a second, which tests can interrupt.
SMALLER = [
    "smoke",
    "--pretrain.contexts",
    "140",
    "--icaa.trials",
    "20",
    "--icaa.context-trials",
    "6",
    "--pretrain.steps",
    "600",
]
# The same with a very small evaluation.
SMOKE = [*SMALLER, "--evaluate.episodes", "1", "--evaluate.seeds", "1", "--evaluate.p", "0"]
# For runs in which no process dies: no spare worker is kept.
NO_RESTARTS = ["--learner.restarts", "0"]


def start(*arguments, **options):
    return subprocess.Popen(
        [*CLI, *map(str, arguments)], stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, **options
    )


def finish(process, timeout=500):
    output, _ = process.communicate(timeout=timeout)
    return output


def result_of(folder):
    return json.loads((folder / "result.json").read_text())


def wait_for(condition, what, timeout=300):
    """Wait until the condition holds; returns its value.  Looking at processes is costly: a tenth of a core at most."""
    deadline = time.monotonic() + timeout
    while True:
        began = time.monotonic()
        if value := condition():
            return value
        assert began < deadline, f"{what} did not happen within {timeout} s"
        time.sleep(0.02 + 9 * (time.monotonic() - began))


def endpoint_of(folder):
    file = folder / "endpoint"
    return wait_for(lambda: file.exists() and file.read_text().strip(), "the start of the learner")


class Acted(threading.Event):
    """Set once something was done; ``link`` is the connection on which it was awaited."""

    link: ZenohLink


@contextlib.contextmanager
def on_first_adapt_trajectory(folder, act, round_=0):
    """Call ``act`` once, when a trajectory of the round appears on the monitor plane; the yielded event is set after it."""
    acted = Acted()

    def receive(key, payload):
        _, fields = wire.decode_message(payload)
        in_round = any(one["identity"].startswith(f"adapt/{round_}") for one in monitor_messages.rows(fields))
        if in_round and not acted.is_set():
            try:
                act()
            finally:
                acted.set()

    with ZenohLink.connect(endpoint_of(folder), timeout_s=30) as link:
        link.subscribe(f"icrl/{folder.name}/mon/trajectories/**", receive)
        acted.link = link
        yield acted


def descendants_of(process):
    return psutil.Process(process.pid).children(recursive=True)


def workers_of(process):
    return [p for p in descendants_of(process) if processes.is_worker(p)]


def equal(result, other):
    return all(result[name] == other[name] for name in ("dataset_digest", "weights_digest", "trajectories"))


def kill_the_tree(process):
    """Send SIGKILL to the command and to all processes that it started, Ray's included."""
    family = [psutil.Process(process.pid), *descendants_of(process)]
    for member in family:
        with contextlib.suppress(psutil.NoSuchProcess):
            member.kill()
    finish(process)
    _, alive = psutil.wait_procs(family, timeout=60)
    assert not alive
