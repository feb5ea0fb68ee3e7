"""The faults: each strikes one training, waits for its end, and returns the evidence that it landed."""

from __future__ import annotations

import contextlib
import os
import time
from collections.abc import Callable
from pathlib import Path

import psutil

from icrl_dist.chaos.command_faults import STOP_S, hang_up, kill_gcs, kill_raylet, kill_run, stop_run, strangers
from icrl_dist.chaos.disk import PAGE, Disk
from icrl_dist.chaos.proxy import Proxy
from icrl_dist.chaos.schedule import Strike
from icrl_dist.chaos.striking import Missed, Struck, kill_all, learner_of, reach, resume
from icrl_dist.chaos.training import Training, TrainingFailed, gone
from icrl_dist.storage import segment
from icrl_dist.storage.dataset import Dataset
from icrl_dist.stream import endpoints

CUT_S = 12.0
"""Seconds for which a link is cut, longer than ``stream.reply_timeout_s``."""


def kill_worker(training: Training, strike: Strike, disk_bytes: int) -> Struck:
    """SIGKILL of a random worker, which is replaced."""
    training.start()
    where = reach(training, strike)
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
    where = reach(training, strike)
    victim = learner_of(training)
    victim.kill()
    result = training.result()
    deaths = result["learner_deaths"]
    return Struck(where, bool(deaths) and gone(victim), f"process {victim.pid} is gone, learner deaths: {deaths}", result)


def kill_tree(training: Training, strike: Strike, disk_bytes: int) -> Struck:
    """SIGKILL of all processes at once, then ``--resume``."""
    where, killed = kill_all(training, strike)
    result = resume(training)
    return Struck(where, True, f"all of {killed} processes gone, resumed", result)


def stop_learner(training: Training, strike: Strike, disk_bytes: int) -> Struck:
    """SIGSTOP of the learner for 15 s, longer than a worker waits for a reply."""
    training.start()
    where = reach(training, strike)
    learner = learner_of(training)
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
        where = reach(training, strike)
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
    where, _ = kill_all(training, strike)
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
    result = resume(training)
    landed = f"{path.name}: cut off a torn tail of" in training.output and result["repaired"] > 0
    return Struck(where, landed, f"{change}, repaired: {result['repaired']}", result)


def flip_checkpoint(training: Training, strike: Strike, disk_bytes: int) -> Struck:
    """One bit of the newest checkpoint of a killed run changes: the resumed run fits that version again."""
    where, _ = kill_all(training, strike)
    versions = sorted((training.view / "checkpoints").glob("version-*.npz"))
    if not versions:
        raise Missed("there was no checkpoint yet")
    path, size = versions[-1], versions[-1].stat().st_size
    place = int(strike.place * size)
    _change_bit(path, place, strike)
    again, result = f"T^{len(versions) - 1} is fitted again", resume(training)
    change = f"{path.name}: a bit of byte {place} of {size} changed"
    return Struck(where, again in training.output, f"{change}; {again}: {again in training.output}", result)


def flip_byte(training: Training, strike: Strike, disk_bytes: int) -> Struck:
    """One byte of a sealed segment changes, in a killed run that is then resumed, or during a run."""
    if strike.variant:
        training.start()
        where = reach(training, strike)
    else:
        where, _ = kill_all(training, strike)
    change, path = _flip(training, strike)
    result = training.result() if strike.variant else resume(training)
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
    _change_bit(path, place, strike)
    lost = len(found.frames) - _readable(path)
    return f"{path.name}: byte {place} of {found.size} changed, which costs {lost} of {len(found.frames)} trajectories", path


def _change_bit(path: Path, place: int, strike: Strike) -> None:
    """Change one bit of the byte at ``place``."""
    with path.open("r+b") as file:
        file.seek(place)
        (byte,) = file.read(1)
        file.seek(place)
        file.write(bytes([byte ^ 1 << strike.worker % 8]))


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
            result = resume(training)
        finally:
            training.kill()
            training.prefix, training.view = [], training.folder
    return Struck(
        where, True, f"exit code 1: {lines[0].removeprefix('icrl-dist: ').replace(f'{training.folder}/', '')}", result
    )


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
    "hang-up": hang_up,
    "kill-run": kill_run,
    "flip-checkpoint": flip_checkpoint,
}
