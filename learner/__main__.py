"""The learner process: ``python -m learner RUN_DIR``.

``icrl-dist train``, the driver, starts and supervises it.  Events go to the file descriptor ``--events``, a JSON
line each; what libraries print goes to stdout and stderr, which are the log ``learner.err``.  The driver writes JSON
objects to stdin, one a line: ``lost``, names of workers that were lost with their nodes, and ``processes``, those that
the driver started, each with its time of creation.  When the driver has died, the learner ends them, writes a
checkpoint and ends.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import select
import signal
import socket
import sys
import threading
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import psutil

from icrl_dist.config.run import ConfigError, load_folder
from icrl_dist.console.signals import on_signals
from icrl_dist.storage.files import StoreError, explained
from icrl_dist.stream import security
from icrl_dist.stream.credit import REQUEST_BYTES
from icrl_dist.stream.link import LinkError
from icrl_dist.stream.zenoh_link import ZenohLink
from icrl_dist.telemetry.logs import log_to
from learner.service import Interrupted, RunFailed, Service

DONE, FAILED, BAD_CONFIG, INTERRUPTED = 0, 1, 2, 130


def main() -> int:
    """Run the learner to its end; returns the exit code of the command line."""
    parser = argparse.ArgumentParser(prog="python -m learner", description=__doc__)
    parser.add_argument("folder", type=Path, help="run folder with a run.toml")
    parser.add_argument(
        "--endpoint", required=True, help="address to listen on, such as tcp/127.0.0.1:7447; port 0 chooses a free port"
    )
    parser.add_argument("--events", type=int, default=1, help="file descriptor for events; default: stdout")
    parser.add_argument(
        "--driver", type=int, default=os.getppid(), help="process that the learner ends with; default: its parent"
    )
    arguments = parser.parse_args()
    log_to(arguments.folder / "learner.log")
    os.set_inheritable(arguments.events, False)
    report = _Events(arguments.events)
    try:
        return _serve(arguments.folder, arguments.endpoint, report, arguments.driver)
    except (ConfigError, LinkError) as error:
        report({"event": "error", "text": str(error)})
        return BAD_CONFIG
    except (RunFailed, StoreError, FloatingPointError, OSError) as error:
        cause = explained(error)
        if isinstance(cause, OSError):  # an unexpected error: keep its traceback
            raise
        report({"event": "error", "text": str(cause)})
        return FAILED


class _Events:
    """Writes each event as a JSON line to a file descriptor, from any thread; nothing once its reader has ended.

    The end of the reader is no error of the event that meets it first: the run still has a checkpoint to write.
    """

    def __init__(self, descriptor: int) -> None:
        self.descriptor = descriptor
        self._lock = threading.Lock()

    def __call__(self, event: dict[str, Any]) -> None:
        line = json.dumps(event).encode() + b"\n"
        with self._lock, contextlib.suppress(BrokenPipeError):
            while line:
                line = line[os.write(self.descriptor, line) :]


def _serve(folder: Path, endpoint: str, report: _Events, driver: int) -> int:
    run = load_folder(folder)
    settings = security.learner(run.stream.certificates, folder.name)
    with ZenohLink.listen(endpoint, settings, run.stream.max_message_bytes + 2 * REQUEST_BYTES) as link:
        service = Service(run, folder, link, report)
        with on_signals(service.stop):
            signal.signal(signal.SIGTERM, lambda *_: service.stop())  # the driver's, also where it was ignored at the start
            processes: list[tuple[int, float]] = []
            threading.Thread(target=_read_driver, args=(service, processes), name="stdin", daemon=True).start()
            _end_with_driver(service, report.descriptor, driver, processes)
            endpoint_file = folder / "endpoint"
            endpoint_file.write_text(link.endpoints[0] + "\n")
            place = {"endpoint": link.endpoints[0], "host": socket.gethostname(), "device": service.device}
            report({"event": "listening", **place, "version": service.version})
            try:
                report({"event": "finished", **service.run()})
                service.worker_api.finish()  # not earlier: a worker that ends before the run counts as lost
                service.worker_api.wait_until_gone()
            except Interrupted:
                checkpoints = folder / "checkpoints"
                missing = "nothing was fitted yet, so there is no checkpoint"
                text = f"a checkpoint is in {checkpoints}" if any(checkpoints.glob("*.npz")) else missing
                report({"event": "interrupted", "text": text})
                return INTERRUPTED
            finally:
                endpoint_file.unlink(missing_ok=True)
                service.close()
    return DONE


def _end_with_driver(service: Service, events: int, driver: int, processes: Sequence[tuple[int, float]]) -> None:
    """When the driver has died, also before this call, stop the service and end ``processes``.

    The reader of ``events`` ends with the driver at once; the parent is looked at too, because a process that the
    driver forked may still hold the reading end.
    """

    def watch() -> None:
        reader = select.poll()
        reader.register(events, 0)  # reports the end of the reader only
        while os.getppid() == driver and not reader.poll(500):
            pass
        service.stop()
        for pid, created in processes:  # Ray's agents would stay for a minute
            with contextlib.suppress(psutil.Error):
                if psutil.Process(pid).create_time() == created:
                    psutil.Process(pid).kill()

    threading.Thread(target=watch, name="driver", daemon=True).start()


def _read_driver(service: Service, processes: list[tuple[int, float]], stdin: int = 0) -> None:
    with (
        contextlib.suppress(OSError),
        open(stdin, "rb", buffering=0, closefd=False) as lines,  # unbuffered: a buffer's lock would block the exit
    ):
        for line in lines:
            message = json.loads(line)
            if lost := message.get("lost"):
                service.worker_api.lost_with_node(lost)
            processes += [(pid, created) for pid, created in message.get("processes", ())]


if __name__ == "__main__":
    sys.exit(main())
