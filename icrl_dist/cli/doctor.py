"""``icrl-dist doctor``: checks of this machine, a cluster file or a cluster."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from rich.console import Console

from icrl_dist.cli.exit_codes import FAILED, OK


@dataclass(frozen=True)
class DoctorArguments:
    """Check this machine: versions, cores, memory, ports, folders; one line and one remedy per check.

    With --cluster: check a cluster file before `ray up`, without contacting a node or a cloud.  Run
    it where you will run `ray up`.  With --address, on the head of a running cluster: check every
    node's versions, clock, shared memory and certificates, and the ports between the nodes.
    """

    cluster: Path | None = None
    """Cluster file to check, such as deploy/clusters/aws.yaml."""
    address: str | None = None
    """Address of a running Ray cluster, such as ``auto``."""
    certificates: str = ""
    """With --address: the folder of the certificates on its nodes."""
    endpoint: str = "tcp/127.0.0.1:0"
    """Endpoint at which a learner would listen."""
    folder: Path = Path("runs")
    """Folder in which run folders would be created."""


def doctor(arguments: DoctorArguments, console: Console) -> int:
    """Print the checks.  Returns FAILED if one of them would stop a run, else OK."""
    from icrl_dist.diagnostics.checks import table
    from icrl_dist.diagnostics.doctor import diagnose, diagnose_cluster, diagnose_file

    if arguments.cluster is not None:
        checks = diagnose_file(arguments.cluster, Path())
    elif arguments.address is not None:
        checks = diagnose_cluster(arguments.address, arguments.endpoint, arguments.certificates)
    else:
        checks = diagnose(arguments.endpoint, arguments.folder)
    console.print(table(checks), highlight=False, markup=False)
    return FAILED if any(check.ok is False for check in checks) else OK
