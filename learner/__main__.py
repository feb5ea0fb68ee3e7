"""The learner process: ``python -m learner RUN_DIR``.  Events go to stdout, a JSON line each.

``icrl-dist train`` starts and supervises it, and writes the names of workers that were lost with their
nodes to its stdin, one JSON list a line.  The process ends by itself if that parent process dies.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import signal
import socket
import sys
import threading
import time
from pathlib import Path
from typing import Any

from icrl_dist.config.run import ConfigError, load_folder
from icrl_dist.storage.files import StoreError, explained
from icrl_dist.stream import security
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
    arguments = parser.parse_args()
    log_to(arguments.folder / "learner.log")
    lock = threading.Lock()

    def report(event: dict[str, Any]) -> None:
        with lock:
            sys.stdout.write(json.dumps(event) + "\n")
            sys.stdout.flush()

    try:
        return _serve(arguments.folder, arguments.endpoint, report)
    except (ConfigError, LinkError) as error:
        report({"event": "error", "text": str(error)})
        return BAD_CONFIG
    except (RunFailed, StoreError, FloatingPointError, OSError) as error:
        cause = explained(error)
        if isinstance(cause, OSError):  # an unexpected error: keep its traceback
            raise
        report({"event": "error", "text": str(cause)})
        return FAILED


def _serve(folder: Path, endpoint: str, report: Any) -> int:
    run = load_folder(folder)
    with ZenohLink.listen(endpoint, security.learner(run.stream.certificates, folder.name)) as link:
        service = Service(run, folder, link, report)
        for name in (signal.SIGINT, signal.SIGTERM):
            signal.signal(name, lambda *_: service.stop())
        _end_with_parent(service)
        threading.Thread(target=_read_lost_workers, args=(service,), name="stdin", daemon=True).start()
        endpoint_file = folder / "endpoint"
        endpoint_file.write_text(link.endpoints[0] + "\n")
        place = {"endpoint": link.endpoints[0], "host": socket.gethostname(), "device": service.device}
        report({"event": "listening", **place, "version": service.version})
        try:
            report({"event": "finished", **service.run()})
            service.worker_api.finish()  # not earlier: a worker that ends before the run counts as lost
            service.worker_api.wait_until_gone()
        except Interrupted:
            report({"event": "interrupted", "text": f"a checkpoint is in {folder / 'checkpoints'}"})
            return INTERRUPTED
        finally:
            endpoint_file.unlink(missing_ok=True)
            service.close()
    return DONE


def _end_with_parent(service: Service) -> None:
    parent = os.getppid()

    def watch() -> None:
        while os.getppid() == parent:
            time.sleep(0.5)
        service.stop()

    threading.Thread(target=watch, name="parent", daemon=True).start()


def _read_lost_workers(service: Service, stdin: int = 0) -> None:
    with (
        contextlib.suppress(OSError),
        open(stdin, "rb", buffering=0, closefd=False) as lines,  # unbuffered: a buffer's lock would block the exit
    ):
        for line in lines:
            service.worker_api.lost_with_node(json.loads(line))


if __name__ == "__main__":
    sys.exit(main())
