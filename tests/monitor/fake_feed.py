"""A feed with a clock that the test sets, and the folder of a finished run, for tests of the views."""

from __future__ import annotations

import json
import shutil
from importlib import resources

import numpy as np

from icrl_dist.monitor.run_state import RunState
from icrl_dist.problems.darkroom import room
from icrl_dist.storage.dataset import Dataset
from icrl_dist.stream import monitor_messages, wire
from icrl_dist.types import NULL, Adversary, Identity, Trajectory, Variation

BEGAN = 1_700_000_000.0
SIZE, HORIZON = 3, 9
DIRICHLET = Adversary.of("dirichlet", p=0.3, alpha=(0.5, 0.1, 2.0, 1.0, 0.7))


def episode(task=0, variation=0, trial=0, total=3, worker="w0", stage="adapt", adversary=None):
    """An episode in the 3x3 room: two steps up, then right, with ``total`` rewards at its end."""
    path = np.array([[0, 0], [0, 1], [0, 2], [1, 2]] + [[2, 2]] * (HORIZON - 3), np.float32)
    none = np.zeros(0, np.int16)
    overridden = np.full(HORIZON, -1, np.int16)
    overridden[1] = 2
    adversary = adversary or (NULL if variation == 0 else DIRICHLET)
    return Trajectory(
        identity=Identity(stage, 0, task, variation, trial),
        variation=Variation(room.task((2, 2), SIZE, HORIZON, (0, 0)), adversary),
        policy_version=0 if stage == "adapt" else -1,
        weights_digest="ab" * 32 if stage == "adapt" else "",
        worker=worker,
        actions=np.zeros(HORIZON, np.int16),
        observations=path,
        rewards=np.concatenate([np.zeros(HORIZON - total), np.ones(total)]).astype(np.float32),
        adversary=overridden,
        queries=np.zeros((0, 2), np.float32),
        labels=np.zeros((0, 5), np.float32),
        prev_actions=none,
        prev_rewards=np.zeros(0, np.float32),
        origin="none",
    )


class FakeFeed:
    """A feed whose messages, time and recording the test sets."""

    def __init__(self, replay=None):
        self.state, self.time, self.recording, self.controls = RunState("demo"), BEGAN, replay, []

    def now(self):
        return self.time

    def replay(self):
        return self.recording

    def control(self, **fields):
        self.controls.append(fields)
        if self.recording is not None:
            self.recording |= fields

    def close(self):
        pass

    def pass_time(self, seconds):
        self.time += seconds
        self.state.tick(self.time)

    def send(self, kind, topic=None, **fields):
        payload = wire.encode_message(kind, time=self.time, **fields)
        self.state.receive(f"icrl/demo/mon/{topic or kind}", payload, self.time)

    def send_run(self):
        phases = [["pretrain", 0, 100], ["adapt", 0, 50]]
        self.send("run", method="icaa", problem="darkroom", phases=phases, rounds=1, tasks=4, variations=8, began=BEGAN)

    def send_progress(self, stage="collect", step=30, steps=120, **fields):
        common = {
            "phase": "adapt",
            "round": 0,
            "version": 0,
            "trajectories": 310,
            "workers": 2,
            "lag": 0,
            "drops": {},
            "doing": [],
        }
        self.send("learner", stage=stage, step=step, steps=steps, **(common | fields))

    def send_heartbeat(self, worker="w0", job="adapt/0/3", **fields):
        common = {"doing": "", "episodes": 40, "trajectories": 38, "steps": 360, "resent": 0, "pid": 7}
        memory = {"memory_mb": 210.0, "peak_mb": 230.0}
        self.send("worker", f"worker/{worker}", worker=worker, job=job, **(common | memory | fields))

    def send_trajectory(self, trajectory):
        self.state.receive("icrl/demo/mon/trajectories/w0", monitor_messages.trajectories([trajectory], self.time), self.time)

    def send_episode(self, trajectory):
        self.state.receive("icrl/demo/mon/episode/w0", monitor_messages.episode(trajectory, self.time), self.time)

    def send_run_in_progress(self):
        """A run in its first round: four tasks of two variations, six episodes each, two workers."""
        self.send_run()
        self.send_progress()
        for task in range(4):
            for variation in range(2):
                for trial in range(6):
                    self.send_trajectory(episode(task, variation, trial, (task + trial) % 6, worker=f"w{task % 2}"))
        self.send_heartbeat("w0")
        self.send_heartbeat("w1", job="adapt/0/1")
        for _ in range(4):
            self.pass_time(0.25)


def run_folder(folder):
    """Writes the files of a finished smoke run that a recording needs; returns ``folder``."""
    folder.mkdir(parents=True)
    shutil.copy(str(resources.files("icrl_dist.config.runs") / "smoke.toml"), folder / "run.toml")
    store = Dataset(folder / "dataset")
    early = [episode(t, 0, trial, trial % 4, stage="pretrain") for t in range(3) for trial in range(8)]
    late = [episode(t, v, trial, (trial + t) % 6) for t in range(3) for v in range(2) for trial in range(8)]
    store.append(early)
    store.append(late)
    store.close()
    common = {"workers": 1, "unstored": 0, "lag": 0, "drops": 0, "resent": 0}
    rows = [
        {"time": BEGAN, "stage": "ingest", "step": 0, "trajectories": 0, "arrived": 0, **common},
        {"time": BEGAN + 2, "stage": "ingest", "step": 0, "trajectories": 24, "arrived": 24, **common},
        {"time": BEGAN + 4, "stage": "fit/0", "step": 30, "loss": 1.2},
        {"time": BEGAN + 6, "stage": "version", "step": 0, "loss": 1.1, "seconds": 4.0},
        {"time": BEGAN + 8, "stage": "ingest", "step": 1, "trajectories": 72, "arrived": 48, **common},
        {"time": BEGAN + 9, "stage": "event", "step": 1, "what": "finished", "text": "the run is finished"},
    ]
    (folder / "metrics.jsonl").write_text("".join(json.dumps(row) + "\n" for row in rows))
    return folder
