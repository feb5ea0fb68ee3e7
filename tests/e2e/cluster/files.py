"""The on-premises file that is shipped, as it is and as the tests' hosts need it."""

import copy
import sys

import yaml
from ray.autoscaler._private.util import prepare_config, validate_config

from tests.e2e import hosts

FILE = hosts.ROOT / "deploy" / "clusters" / "onprem.yaml"


def shipped():
    return yaml.safe_load(FILE.read_text())


def accepted(config):
    """The configuration as Ray fills it in; raises what Ray raises for one that it refuses."""
    whole = prepare_config(copy.deepcopy(config))
    validate_config(whole)
    return whole


def filled_in(head, workers):
    """The shipped file for these hosts, which have the tests' environment already, and a core each to give."""
    config = shipped()
    config["provider"] |= {"head_ip": head.address, "worker_ips": [worker.address for worker in workers]}
    config["auth"] |= {"ssh_user": "root", "ssh_private_key": "~/.ssh/id_ed25519"}
    _make, _install, path = config["setup_commands"]
    config["setup_commands"] = [f"ln -sfn {sys.prefix} ~/icrl-dist/.venv", path.replace("$PATH", f"$PATH {hosts.CODE}")]
    config["worker_start_ray_commands"][-1] += " --num-cpus=1"
    return yaml.safe_dump(config)
