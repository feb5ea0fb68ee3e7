"""Monitor messages for tests of the live view."""

import numpy as np

from icrl_dist.stream import monitor_messages, wire
from icrl_dist.types import Adversary, Identity, Task, Trajectory, Variation

ROOM = Task.of("darkroom", goal=(2, 1), size=4, horizon=9, start=(0, 0))
DIRICHLET = Adversary.of("dirichlet", p=0.2, alpha=(1.0, 1.0, 1.0, 1.0, 1.0))


def trajectory(identity="adapt/0/3/1/7", total=2.0, worker="w0", task=ROOM, adversary=DIRICHLET, **changes):
    """A trajectory of Dark Room with return ``total``."""
    horizon = 9
    rewards = np.zeros(horizon, np.float32)
    rewards[: int(total)] = 1.0
    path = np.minimum(np.arange(horizon + 1), 3).astype(np.float32)
    fields = {
        "identity": Identity.parse(identity),
        "variation": Variation(task, adversary),
        "policy_version": 0,
        "weights_digest": "d" * 64,
        "worker": worker,
        "actions": np.zeros(horizon, np.int16),
        "observations": np.stack([path, np.zeros_like(path)], axis=1),
        "rewards": rewards,
        "adversary": np.where(np.arange(horizon) == 2, 1, -1).astype(np.int16),
        "queries": np.zeros((0, 2), np.float32),
        "labels": np.zeros((0, 5), np.float32),
        "prev_actions": np.zeros(0, np.int16),
        "prev_rewards": np.zeros(0, np.float32),
        "origin": "none",
    }
    return Trajectory(**(fields | changes))


def heartbeat(worker="w0", **changes):
    """A ``worker`` message."""
    counts = {"episodes": 0, "steps": 0, "resent": 0, "trajectories": 0, "pid": 7}
    fields = {"job": "adapt/0/3", "doing": "", "policy_version": 0, "memory_mb": 100.0, "peak_mb": 120.0, "time": 0.0}
    return wire.encode_message("worker", **({"worker": worker} | counts | fields | changes))


def progress(**changes):
    """A ``learner`` message."""
    stage = {"stage": "collect", "phase": "adapt", "round": 0, "step": 10, "steps": 100}
    counts = {"version": 0, "trajectories": 10, "workers": 1, "lag": 0, "drops": {}, "doing": [], "time": 0.0}
    return wire.encode_message("learner", **(stage | counts | changes))


def run_info(**changes):
    """A ``run`` message."""
    fields = {"method": "icaa", "problem": "darkroom", "rounds": 2, "tasks": 7, "variations": 14, "began": -5.0, "time": 0.0}
    phases = [["pretrain", 0, 60], ["adapt", 0, 30], ["adapt", 1, 30]]
    return wire.encode_message("run", **({**fields, "phases": phases} | changes))


def event(what, text, **changes):
    """An ``event`` message."""
    return wire.encode_message("event", **({"what": what, "text": text, "time": 1.0} | changes))


def send(state, topic, payload, now=0.0, run="demo"):
    """Deliver a message to a run state."""
    state.receive(f"icrl/{run}/mon/{topic}", payload, now)


def send_trajectories(state, *trajectories, now=0.0):
    """Deliver the ``trajectories`` and ``episode`` messages of some trajectories."""
    for one in trajectories:
        send(state, f"trajectories/{one.worker}", monitor_messages.trajectories([one], now), now)
        send(state, f"episode/{one.worker}", monitor_messages.episode(one, now), now)
