"""Ray accepts the on-premises cluster file, and the file copies every source of the package to the nodes."""

import tomllib

import click
import jsonschema
import pytest

from tests.e2e import simulated_nodes
from tests.e2e.cluster.files import accepted, shipped


def test_ray_accepts_the_shipped_file_with_every_worker_node():
    whole = accepted(shipped())
    (kind,) = whole["available_node_types"].values()
    assert kind["min_workers"] == kind["max_workers"] == len(shipped()["provider"]["worker_ips"])


@pytest.mark.parametrize(
    ("where", "key", "value"),
    [
        ((), "setup_comands", []),
        ((), "worker_start_ray_commands", "ray start"),
        ((), "idle_timeout_minutes", "five"),
        (("auth",), "ssh_usr", "ubuntu"),
        (("auth",), "ssh_private_key", 7),
    ],
)
def test_ray_refuses_a_file_with_a_mistake(where, key, value):
    config = shipped()
    table = config
    for name in where:
        table = table[name]
    table[key] = value
    with pytest.raises(jsonschema.ValidationError, match=key if key not in shipped() else str(value)):
        accepted(config)


def test_ray_refuses_a_file_without_worker_nodes():
    config = shipped()
    del config["provider"]["worker_ips"]
    with pytest.raises(click.ClickException):
        accepted(config)


def test_all_sources_of_the_package_are_copied_to_the_nodes():
    project = tomllib.loads((simulated_nodes.ROOT / "pyproject.toml").read_text())
    sources = {source for source in shipped()["file_mounts"].values() if not source.startswith("~")}
    assert sources == {"pyproject.toml", "constraints.txt", project["project"]["readme"]} | {
        package.removesuffix("*") for package in project["tool"]["setuptools"]["packages"]["find"]["include"]
    }
    assert all((simulated_nodes.ROOT / source).exists() for source in sources)
