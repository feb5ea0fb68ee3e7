"""The faults: each strikes one training, waits for its end, and returns the evidence that it landed."""

from __future__ import annotations

import contextlib
import os
import signal
import socket
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import psutil

from icrl_dist.chaos.disk import PAGE, Disk
from icrl_dist.chaos.proxy import Proxy
from icrl_dist.chaos.schedule import Strike
from icrl_dist.chaos.training import Training, TrainingFailed, gone
from icrl_dist.storage import segment
from icrl_dist.storage.dataset import Dataset
from icrl_dist.stream import endpoints

STRANGERS = 1500
"""Connections of a flood; the learner admits fewer."""
STOP_S, CUT_S = 15.0, 12.0
"""Durations of a stopped learner and of a cut link, longer than ``stream.reply_timeout_s``."""


@dataclass(frozen=True)
class Struck:
    """The effect of a fault."""

    where: str
    """The run's progress when it struck."""
    landed: bool
    evidence: str
    result: dict[str, Any]
    """The run's ``result.json``."""


class Missed(Exception):  # noqa: N818
    """The strike found nothing to hit; the message says why."""


def kill_worker(training: Training, strike: Strike, disk_bytes: int) -> Struck:
    """SIGKILL of a random worker, which is replaced."""
    training.start()
    where = _reach(training, strike)
    workers = training.workers()
    if not workers:
        raise Missed("there was no worker")
    victim = workers[strike.worker % len(workers)]
    victim.kill()
    result = training.result()
    deaths = result["worker_deaths"]
    return Struck(where, bool(deaths) and gone(victim), f"process {victim.pid} is gone, worker deaths: {deaths}", result)


def kill_learner(training: Training, strike: Strike, disk_bytes: int) -> Struck:
    """SIGKILL of the learner during collection or a fit; it restarts from its checkpoint and its dataset."""
    training.start()
    where = _reach(training, strike)
    victim = _learner(training)
    victim.kill()
    result = training.result()
    deaths = result["learner_deaths"]
    return Struck(where, bool(deaths) and gone(victim), f"process {victim.pid} is gone, learner deaths: {deaths}", result)


def kill_tree(training: Training, strike: Strike, disk_bytes: int) -> Struck:
    """SIGKILL of all processes at once, then ``--resume``."""
    where, killed = _kill_all(training, strike)
    result = _resume(training)
    return Struck(where, True, f"all of {killed} processes gone, resumed", result)


def stop_learner(training: Training, strike: Strike, disk_bytes: int) -> Struck:
    """SIGSTOP of the learner for 15 s, longer than a worker waits for a reply."""
    training.start()
    where = _reach(training, strike)
    learner = _learner(training)
    learner.suspend()
    try:
        time.sleep(STOP_S)
        stopped = learner.status() == psutil.STATUS_STOPPED
    finally:
        learner.resume()
    result = training.result()
    return Struck(
        where, stopped and result["resent"] > 0, f"stopped: {stopped}, trajectories sent again: {result['resent']}", result
    )


def cut_link(training: Training, strike: Strike, disk_bytes: int) -> Struck:
    """No data passes between workers and learner for 12 s, and no connection is closed."""
    protocol = endpoints.parse(training.run.stream.endpoint).protocol
    with Proxy(training.target) as proxy:
        training.start("--stream.connect", f"{protocol}/127.0.0.1:{proxy.port}")
        where = _reach(training, strike)
        before, printed = proxy.forwarded, len(training.output)
        proxy.cut()
        time.sleep(CUT_S)
        proxy.mend()
        result = training.result()
        after = training.output[printed:]
    back, resent = after.count("is back"), result["resent"]
    evidence = f"{before >> 10} KiB passed before; sent again: {resent}, workers that left and came back: {back}"
    return Struck(where, before > 0 and (resent > 0 or back > 0), evidence, result)


def torn_tail(training: Training, strike: Strike, disk_bytes: int) -> Struck:
    """A power cut during an append: all processes die, and the newest segment ends in half a frame."""
    where, _ = _kill_all(training, strike)
    path = training.segments()[-1] if training.segments() else training.folder
    found = segment.scan(path) if path.is_file() else segment.Scan()
    if found.sealed or not found.frames:
        raise Missed(f"{path.name} was sealed or empty")
    offset, length = found.frames[-1]
    start = offset - segment.HEADER_BYTES
    content = path.read_bytes()
    cut = 1 + int(strike.place * (segment.HEADER_BYTES + length - 2))
    if strike.variant:
        path.write_bytes(content + content[start : start + cut])
        change = f"{path.name}: {cut} bytes of a frame added"
    else:
        os.truncate(path, len(content) - cut)
        change = f"{path.name}: {cut} bytes of the last frame cut off"
    result = _resume(training)
    landed = f"{path.name}: cut off a torn tail of" in training.output and result["repaired"] > 0
    return Struck(where, landed, f"{change}, repaired: {result['repaired']}", result)


def flip_byte(training: Training, strike: Strike, disk_bytes: int) -> Struck:
    """One byte of a sealed segment changes, in a killed run that is then resumed, or during a run."""
    if strike.variant:
        training.start()
        where = _reach(training, strike)
    else:
        where, _ = _kill_all(training, strike)
    change, path = _flip(training, strike)
    result = training.result() if strike.variant else _resume(training)
    landed = f"{path.name}: removed" in training.output and result["repaired"] > 0
    how = "during the run" if strike.variant else "then resumed"
    return Struck(where, landed, f"{change} {how}, repaired: {result['repaired']}", result)


def _flip(training: Training, strike: Strike) -> tuple[str, Path]:
    """Change one byte of a sealed segment; returns a description and the segment."""
    sealed = [(path, found) for path in training.segments() if (found := segment.scan(path)).sealed]
    if not sealed:
        raise Missed("no segment was sealed yet")
    path, found = sealed[strike.worker % len(sealed)]
    first = (
        found.frames[0][0] - segment.HEADER_BYTES if strike.variant else 0
    )  # during a run only the trajectories are read again
    place = first + int(strike.place * (found.size - (segment.SEAL_BYTES if strike.variant else 0) - first))
    with path.open("r+b") as file:
        file.seek(place)
        (byte,) = file.read(1)
        file.seek(place)
        file.write(bytes([byte ^ 1 << strike.worker % 8]))
    lost = len(found.frames) - _readable(path)
    return f"{path.name}: byte {place} of {found.size} changed, which costs {lost} of {len(found.frames)} trajectories", path


def _readable(path: Path) -> int:
    """The number of intact trajectories of a segment whose names are intact too."""
    found, count = segment.scan(path), 0
    with path.open("rb") as file:
        for offset, length in found.frames:
            file.seek(offset)
            with contextlib.suppress(segment.MissingName):
                segment.decode(file.read(length), found.names)
                count += 1
    return count


def full_disk(training: Training, strike: Strike, disk_bytes: int) -> Struck:
    """The disk of the run folder fills up; the run ends with a remedy, which is then applied."""
    size = int((0.1 + 0.9 * strike.place) * disk_bytes) // PAGE * PAGE
    with Disk(training.folder, size) as disk:
        training.prefix, training.view = disk.prefix, disk.view
        try:
            training.start()
            code = training.wait()
            output = training.output
            lines = [line for line in output.splitlines() if "No space left on device" in line]
            if code == 0:
                raise Missed(f"the run did not fill a disk of {size >> 10} KiB")
            if code != 1 or len(lines) != 1 or "free space, then use --resume" not in lines[0] or "Traceback" in output:
                last = output.splitlines()[-1]
                raise TrainingFailed(f"on a full disk: exit code {code}, {len(lines)} lines about it; the last line: {last}")
            dataset = Dataset(training.view / "dataset", readonly=True)
            stored = len(dataset)
            dataset.close()
            where = f"disk of {size >> 10} KiB, {stored} trajectories stored"
            disk.grow(4 * disk_bytes + (64 << 20))
            result = _resume(training)
        finally:
            training.kill()
            training.prefix, training.view = [], training.folder
    return Struck(
        where, True, f"exit code 1: {lines[0].removeprefix('icrl-dist: ').replace(f'{training.folder}/', '')}", result
    )


def strangers(training: Training, strike: Strike, disk_bytes: int) -> Struck:
    """A flood of connections that send nothing, held until the run ends."""
    training.start()
    where, made = _reach(training, strike), 0
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
    where = _reach(training, strike)
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


def kill_raylet(training: Training, strike: Strike, disk_bytes: int) -> Struck:
    """SIGKILL of the raylet, then of the workers, as the kernel does when memory runs out."""
    return _kill_ray(training, strike, "raylet", and_workers=True)


def kill_gcs(training: Training, strike: Strike, disk_bytes: int) -> Struck:
    """SIGKILL of Ray's GCS, without which Ray ends this command after a while."""
    return _kill_ray(training, strike, "gcs_server", and_workers=False)


def _kill_ray(training: Training, strike: Strike, name: str, and_workers: bool) -> Struck:
    """The run goes on with a new session of Ray, or ends with a line about it, and ``--resume`` finishes it."""
    training.start()
    where = _reach(training, strike)
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
    result = _resume(training) if code else training.result()
    how = (
        "the run ended and was resumed" if code else "Ray was started again" if line in ended else "the run finished without it"
    )
    return Struck(where, all(map(gone, victims)), f"{name} {victims[0].pid} is gone; {how}", result)


FAULTS: dict[str, Callable[[Training, Strike, int], Struck]] = {
    "kill-worker": kill_worker,
    "kill-learner": kill_learner,
    "kill-tree": kill_tree,
    "stop-learner": stop_learner,
    "cut-link": cut_link,
    "torn-tail": torn_tail,
    "flip-byte": flip_byte,
    "full-disk": full_disk,
    "strangers": strangers,
    "stop-run": stop_run,
    "kill-raylet": kill_raylet,
    "kill-gcs": kill_gcs,
}


def _reach(training: Training, strike: Strike) -> str:
    where = training.reach(strike)
    if not where:
        raise Missed(f"the run ended before {strike}")
    return where


def _learner(training: Training) -> psutil.Process:
    found = training.learner()
    if found is None:
        raise Missed("the learner had ended")
    return found


def _kill_all(training: Training, strike: Strike) -> tuple[str, int]:
    training.start()
    where = _reach(training, strike)
    count = len(training.tree())
    if left := training.kill():
        raise TrainingFailed(f"{len(left)} processes are alive after SIGKILL, such as {left[0].pid}")
    if training.finished():
        raise Missed("the run had ended")
    return where, count


def _resume(training: Training) -> dict[str, Any]:
    training.start("--resume")
    return training.result()
