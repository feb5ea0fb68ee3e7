"""The shipped on-premises cluster file: unchanged, and adapted to simulated nodes."""

import copy
import sys

import yaml
from ray.autoscaler._private.util import prepare_config, validate_config

from tests.e2e import simulated_nodes

FILE = simulated_nodes.ROOT / "deploy" / "clusters" / "onprem.yaml"


def shipped():
    return yaml.safe_load(FILE.read_text())


def accepted(config):
    """The configuration as Ray completes it; raises Ray's exception for one that it refuses."""
    whole = prepare_config(copy.deepcopy(config))
    validate_config(whole)
    return whole


def filled_in(head, workers):
    """The shipped file for these nodes, which have the tests' environment installed and offer one core each."""
    config = shipped()
    config["provider"] |= {"head_ip": head.address, "worker_ips": [worker.address for worker in workers]}
    config["auth"] |= {"ssh_user": "root", "ssh_private_key": "~/.ssh/id_ed25519"}
    _make, _install, path = config["setup_commands"]
    config["setup_commands"] = [
        f"ln -sfn {sys.prefix} ~/icrl-dist/.venv",
        path.replace("$PATH", f"$PATH {simulated_nodes.CODE}"),
    ]
    config["worker_start_ray_commands"][-1] += " --num-cpus=1"
    return yaml.safe_dump(config)
