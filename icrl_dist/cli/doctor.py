"""``icrl-dist doctor``."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from rich.console import Console

from icrl_dist.cli.exit_codes import FAILED, OK


@dataclass(frozen=True)
class DoctorArguments:
    """Check this machine: versions, cores, memory, ports, folders; one line and a remedy each.

    Or, with --cluster, a cluster file before `ray up`, without asking any machine or cloud; run it
    where `ray up` will be run.  Or, with --address on its head, a cluster that is up: every
    machine's versions, clock, shared memory, certificates, and the ports between them.
    """

    cluster: Path | None = None
    """Cluster file to look through, such as deploy/clusters/aws.yaml."""
    address: str | None = None
    """Address of a Ray cluster, such as ``auto``."""
    certificates: str = ""
    """With --address: the folder of certificates on its machines."""
    endpoint: str = "tcp/127.0.0.1:0"
    """Where a learner would listen."""
    folder: Path = Path("runs")
    """Where run folders would be made."""


def doctor(arguments: DoctorArguments, console: Console) -> int:
    """``icrl-dist doctor``: exit code 1 if anything would stop a run."""
    from icrl_dist.diagnostics.doctor import diagnose, diagnose_cluster, diagnose_file, table

    if arguments.cluster is not None:
        findings = diagnose_file(arguments.cluster, Path())
    elif arguments.address is not None:
        findings = diagnose_cluster(arguments.address, arguments.endpoint, arguments.certificates)
    else:
        findings = diagnose(arguments.endpoint, arguments.folder)
    console.print(table(findings), highlight=False, markup=False)
    return FAILED if any(finding.ok is False for finding in findings) else OK
