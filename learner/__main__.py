"""The learner process: ``python -m learner RUN_DIR``.  Events go to stdout, a JSON line each.

Started and supervised by ``icrl-dist train``, which names workers that were lost with their machines
on stdin, a JSON list a line; ends by itself if that parent dies.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import logging
import os
import signal
import socket
import sys
import threading
import time
from pathlib import Path
from typing import Any

from icrl_dist.config.run import ConfigError, load
from icrl_dist.storage.files import StoreError, explained
from icrl_dist.stream import security
from icrl_dist.stream.link import LinkError
from icrl_dist.stream.zenoh_link import ZenohLink
from learner.service import Interrupted, RunFailed, Service

DONE, FAILED, BAD_CONFIG, INTERRUPTED = 0, 1, 2, 130


def main() -> int:
    """Run the learner to its end; the exit code is the command line's."""
    parser = argparse.ArgumentParser(prog="python -m learner", description=__doc__)
    parser.add_argument("folder", type=Path, help="run folder with a run.toml")
    parser.add_argument(
        "--endpoint", required=True, help="where to listen, such as tcp/127.0.0.1:7447; port 0 takes a free one"
    )
    arguments = parser.parse_args()
    logging.basicConfig(filename=arguments.folder / "learner.log", level=logging.INFO, format="%(asctime)s %(message)s")
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
        told = explained(error)
        if isinstance(told, OSError):  # which nobody foresaw
            raise
        report({"event": "error", "text": str(told)})
        return FAILED


def _serve(folder: Path, endpoint: str, report: Any) -> int:
    run = load(str(folder / "run.toml"))
    with ZenohLink.listen(endpoint, security.learner(run.stream.certificates, folder.name)) as link:
        service = Service(run, folder, link, report)
        for name in (signal.SIGINT, signal.SIGTERM):
            signal.signal(name, lambda *_: service.stop())
        _end_with_parent(service)
        threading.Thread(target=_listen, args=(service,), name="stdin", daemon=True).start()
        where = folder / "endpoint"
        where.write_text(link.endpoints[0] + "\n")
        place = {"endpoint": link.endpoints[0], "host": socket.gethostname(), "device": service.device}
        report({"event": "listening", **place, "version": service.version})
        try:
            report({"event": "finished", **service.run()})
            service.desk.finish()  # not before: workers that end before the run does would look lost
            service.desk.dismiss()
        except Interrupted:
            report({"event": "interrupted", "text": f"a checkpoint is in {folder / 'checkpoints'}"})
            return INTERRUPTED
        finally:
            where.unlink(missing_ok=True)
            service.close()
    return DONE


def _end_with_parent(service: Service) -> None:
    parent = os.getppid()

    def watch() -> None:
        while os.getppid() == parent:
            time.sleep(0.5)
        service.stop()

    threading.Thread(target=watch, name="parent", daemon=True).start()


def _listen(service: Service, stdin: int = 0) -> None:
    with (
        contextlib.suppress(OSError),
        open(stdin, "rb", buffering=0, closefd=False) as told,
    ):  # nothing buffered is locked at exit
        for line in told:
            service.desk.excuse(json.loads(line))


if __name__ == "__main__":
    sys.exit(main())
