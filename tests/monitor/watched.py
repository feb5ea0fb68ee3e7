"""A run to be watched that nobody runs: real messages, and a feed whose clock the test moves."""

from __future__ import annotations

import json
import shutil
from importlib import resources

import numpy as np

from icrl_dist.monitor.picture import Picture
from icrl_dist.problems.darkroom import room
from icrl_dist.storage.dataset import Dataset
from icrl_dist.stream import monitor_messages, wire
from icrl_dist.types import NULL, Adversary, Identity, Trajectory, Variation

BEGAN = 1_700_000_000.0
SIZE, HORIZON = 3, 9
DIRICHLET = Adversary.of("dirichlet", p=0.3, alpha=(0.5, 0.1, 2.0, 1.0, 0.7))


def episode(task=0, variation=0, trial=0, earned=3, worker="w0", stage="adapt", adversary=None):
    """An episode in the 3x3 room: up twice, then right, and ``earned`` rewards at its end."""
    path = np.array([[0, 0], [0, 1], [0, 2], [1, 2]] + [[2, 2]] * (HORIZON - 3), np.float32)
    none = np.zeros(0, np.int16)
    moved = np.full(HORIZON, -1, np.int16)
    moved[1] = 2
    adversary = adversary or (NULL if variation == 0 else DIRICHLET)
    return Trajectory(
        identity=Identity(stage, 0, task, variation, trial),
        variation=Variation(room.task((2, 2), SIZE, HORIZON, (0, 0)), adversary),
        policy_version=0 if stage == "adapt" else -1,
        weights_digest="ab" * 32 if stage == "adapt" else "",
        worker=worker,
        actions=np.zeros(HORIZON, np.int16),
        observations=path,
        rewards=np.concatenate([np.zeros(HORIZON - earned), np.ones(earned)]).astype(np.float32),
        adversary=moved,
        queries=np.zeros((0, 2), np.float32),
        labels=np.zeros((0, 5), np.float32),
        taken=none,
        gained=np.zeros(0, np.float32),
        origin="none",
    )


class Watched:
    """A feed of what the test says."""

    def __init__(self, replay=None):
        self.picture, self.time, self.recording, self.controls = Picture("demo"), BEGAN, replay, []

    def now(self):
        return self.time

    def replay(self):
        return self.recording

    def control(self, **wanted):
        self.controls.append(wanted)
        if self.recording is not None:
            self.recording |= wanted

    def close(self):
        pass

    def pass_time(self, seconds):
        self.time += seconds
        self.picture.tick(self.time)

    def say(self, kind, topic=None, **fields):
        payload = wire.encode_message(kind, time=self.time, **fields)
        self.picture.hear(f"icrl/demo/mon/{topic or kind}", payload, self.time)

    def about(self):
        phases = [["pretrain", 0, 100], ["adapt", 0, 50]]
        self.say("run", method="icaa", problem="darkroom", phases=phases, rounds=1, tasks=4, variations=8, began=BEGAN)

    def progress(self, stage="collect", step=30, steps=120, **fields):
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
        self.say("learner", stage=stage, step=step, steps=steps, **(common | fields))

    def beat(self, worker="w0", job="adapt/0/3", **fields):
        common = {"doing": "", "episodes": 40, "trajectories": 38, "steps": 360, "resent": 0, "pid": 7}
        memory = {"memory_mb": 210.0, "peak_mb": 230.0}
        self.say("worker", f"worker/{worker}", worker=worker, job=job, **(common | memory | fields))

    def store(self, trajectory):
        self.picture.hear("icrl/demo/mon/trajectories/w0", monitor_messages.trajectories([trajectory], self.time), self.time)

    def draw(self, trajectory):
        self.picture.hear("icrl/demo/mon/episode/w0", monitor_messages.episode(trajectory, self.time), self.time)

    def busy(self):
        """Four tasks of two variations, two workers."""
        self.about()
        self.progress()
        for task in range(4):
            for variation in range(2):
                for trial in range(6):
                    self.store(episode(task, variation, trial, earned=(task + trial) % 6, worker=f"w{task % 2}"))
        self.beat("w0")
        self.beat("w1", job="adapt/0/1")
        for _ in range(4):
            self.pass_time(0.25)


def run_folder(folder):
    """The folder of a finished run of smoke, as far as a recording needs it."""
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
