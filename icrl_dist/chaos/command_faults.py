"""The faults of what surrounds learner and workers: the command, Ray's processes, strangers on the port."""

from __future__ import annotations

import contextlib
import signal
import socket
import time

import psutil

from icrl_dist.chaos.schedule import Strike
from icrl_dist.chaos.striking import Missed, Struck, reach, resume
from icrl_dist.chaos.training import Training, TrainingFailed, gone
from icrl_dist.storage.checkpoint import partial_file

STRANGERS = 1500
"""Connections of a flood; the learner admits fewer."""
STOP_S = 15.0
"""Seconds for which the command is stopped, longer than ``stream.reply_timeout_s``."""
ENDED_S = 60.0
"""Seconds within which the processes of a killed command end: the learner writes a checkpoint first."""
INTERRUPTED = 130
"""Exit code of a run that a signal ended in order."""


def strangers(training: Training, strike: Strike, disk_bytes: int) -> Struck:
    """A flood of connections that send nothing, held until the run ends."""
    training.start()
    where, made = reach(training, strike), 0
    target = training.target()
    if target is None:
        raise Missed("the learner had ended")
    with contextlib.ExitStack() as held:
        with contextlib.suppress(TimeoutError):
            for made in range(STRANGERS):  # noqa: B007
                held.enter_context(socket.create_connection(target, timeout=0.5))
        result = training.result()
    return Struck(
        where, made >= 64, f"{made} connections held, then {'no' if made + 1 < STRANGERS else 'any'} more admitted", result
    )


def stop_run(training: Training, strike: Strike, disk_bytes: int) -> Struck:
    """SIGSTOP of the command's process group for 15 s; the learner and the workers, in groups of their own, go on."""
    training.start()
    where = reach(training, strike)
    group = training.group()
    training.signal(signal.SIGSTOP)
    try:
        time.sleep(STOP_S)
        stopped = sum(process.is_running() and process.status() == psutil.STATUS_STOPPED for process in group)
        learner_finished = training.learner() is None
    finally:
        training.signal(signal.SIGCONT)
    result = training.result()
    evidence = f"processes that were stopped: {stopped} of {len(group)}; the learner finished meanwhile: {learner_finished}"
    return Struck(where, 0 < stopped == len(group), evidence, result)


def hang_up(training: Training, strike: Strike, disk_bytes: int) -> Struck:
    """SIGHUP of the command, as when the connection of its terminal breaks; then ``--resume``."""
    training.start()
    where = reach(training, strike)
    training.command().send_signal(signal.SIGHUP)
    code = training.wait()
    if code == 0:
        raise Missed("the run had finished")
    if code != INTERRUPTED:
        raise TrainingFailed(f"after SIGHUP: exit code {code}; the last line: {training.output.splitlines()[-1]}")
    kept = _partial(training)
    return Struck(where, True, f"exit code {code}, checkpoint of the fit: {kept}; resumed", resume(training))


def kill_run(training: Training, strike: Strike, disk_bytes: int) -> Struck:
    """SIGKILL of the command alone: the learner writes its checkpoint, and all other processes end; then ``--resume``."""
    training.start()
    where = reach(training, strike)
    others = [process for process in training.tree() if process != training.command()]
    training.command().kill()
    began = time.monotonic()
    while left := [process for process in others if not gone(process)]:
        if time.monotonic() - began > ENDED_S:
            raise TrainingFailed(f"{len(left)} processes are alive {ENDED_S:.0f} s after their command, such as {left[0].pid}")
        time.sleep(0.1)
    took = time.monotonic() - began
    if training.finished():
        raise Missed("the run had finished")
    evidence = f"{len(others)} other processes ended within {took:.1f} s, checkpoint of the fit: {_partial(training)}; resumed"
    return Struck(where, training.wait() == -signal.SIGKILL, evidence, resume(training))


def _partial(training: Training) -> bool:
    return partial_file(training.view).exists()


def kill_raylet(training: Training, strike: Strike, disk_bytes: int) -> Struck:
    """SIGKILL of the raylet, then of the workers, as the kernel does when memory runs out."""
    return _kill_ray(training, strike, "raylet", and_workers=True)


def kill_gcs(training: Training, strike: Strike, disk_bytes: int) -> Struck:
    """SIGKILL of Ray's GCS, without which Ray ends this command after a while."""
    return _kill_ray(training, strike, "gcs_server", and_workers=False)


def _kill_ray(training: Training, strike: Strike, name: str, and_workers: bool) -> Struck:
    """The run goes on with a new session of Ray, or ends with a line about it, and ``--resume`` finishes it."""
    training.start()
    where = reach(training, strike)
    victims = [process for process in training.tree() if process.name() == name]
    if not victims:
        raise Missed(f"there was no {name}")
    for process in [*victims, *(training.workers() if and_workers else ())]:
        with contextlib.suppress(psutil.NoSuchProcess):
            process.kill()
    code, line = training.wait(), f"Ray's process {name} ({victims[0].pid}) has ended"
    ended = training.output
    if code and (code != 1 or ended.count(line) != 1 or "Traceback" in ended):
        raise TrainingFailed(f"without its {name}: exit code {code}; the last line: {ended.splitlines()[-1]}")
    result = resume(training) if code else training.result()
    how = (
        "the run ended and was resumed" if code else "Ray was started again" if line in ended else "the run finished without it"
    )
    return Struck(where, all(map(gone, victims)), f"{name} {victims[0].pid} is gone; {how}", result)
