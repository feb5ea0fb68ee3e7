"""Checks of a cluster file for ``ray up`` that Ray does not make itself.

Ray's schema covers neither the content of ``node_config`` nor what a run needs on the nodes.  The
checks are offline: they contact no cloud and no node.
"""

from __future__ import annotations

import ipaddress
import json
import os
import zipfile
from collections.abc import Iterator
from importlib import resources
from pathlib import Path
from typing import Any

import yaml

from icrl_dist import version
from icrl_dist.config.run import ConfigError
from icrl_dist.config.toml import nearest
from icrl_dist.diagnostics.checks import Check

_REQUIRED = {"aws": ("InstanceType", "ImageId"), "gcp": ("machineType", "disks")}
_PLACEHOLDERS = ("ami-00000000000000000", "PROJECT", "projects/PROJECT/", "REGISTRY/")
_DOCUMENTATION = ipaddress.ip_network("192.0.2.0/24")
"""Addresses reserved for examples (RFC 5737)."""


def load(file: Path) -> dict[str, Any]:
    """The file as a dictionary.  Raises ConfigError if it cannot be read or is no cluster file."""
    try:
        config = yaml.safe_load(file.read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigError(
            f"--cluster {file}: cannot be read ({error}); name a file such as deploy/clusters/onprem.yaml"
        ) from None
    except yaml.YAMLError as error:
        raise ConfigError(f"--cluster {file}: not YAML: {' '.join(str(error).split())}") from None
    if not isinstance(config, dict) or not isinstance(config.get("provider"), dict):
        raise ConfigError(f"--cluster {file}: no cluster file, it has no provider; start from deploy/clusters/onprem.yaml")
    return config


def check_file(config: dict[str, Any], root: Path) -> list[Check]:
    """All checks of the file; local paths in it are relative to ``root``, the folder where ``ray up`` is run."""
    cloud = str(config["provider"].get("type"))
    return [
        *_provider(config),
        *(_node_configs(cloud, config) if cloud in _REQUIRED else ()),
        *_head(config),
        _workers(config),
        *_mounts(config, root),
        *_commands(config),
        *_container(config),
        _filled_in(config),
    ]


def _provider(config: dict[str, Any]) -> Iterator[Check]:
    provider = config["provider"]
    kind = provider.get("type")
    if kind not in ("local", *_REQUIRED):
        yield Check(
            "provider", None, f"type {kind}: only local, aws and gcp are checked here", "check its node_config yourself"
        )
        return
    missing = [
        key
        for key in ("region", "availability_zone", *(["project_id"] * (kind == "gcp")))
        if kind != "local" and not provider.get(key)
    ]
    zones = [zone.strip() for zone in str(provider.get("availability_zone", "")).split(",") if zone.strip()]
    elsewhere = [zone for zone in zones if not zone.startswith(str(provider.get("region")))]
    if missing:
        yield Check("provider", False, f"{kind} without {', '.join(missing)}", f"set provider.{missing[0]}")
    elif kind != "local" and elsewhere:
        yield Check("provider", False, f"zone {elsewhere[0]} is not in region {provider['region']}", "change one of them")
    elif len(zones) > 1:
        yield Check(
            "provider", None, f"zones {', '.join(zones)}", "name one zone: traffic between zones is slower and costs money"
        )
    else:
        yield Check("provider", True, f"{kind}{' ' + zones[0] if zones else ''}")


def _node_configs(cloud: str, config: dict[str, Any]) -> Iterator[Check]:
    schema = json.loads((resources.files("icrl_dist.diagnostics.clouds") / f"{cloud}.json").read_text())
    for name, kind in (config.get("available_node_types") or {}).items():
        node = kind.get("node_config") or {}
        missing = [key for key in _REQUIRED[cloud] if key not in node]
        errors = [*_violations(node, schema, f"{name}.node_config")]
        errors += [(f"{name}.node_config without {key}", f"set {key}") for key in missing]
        for value, remedy in errors:
            yield Check("node_config", False, value, remedy)
        if not errors:
            yield Check("node_config", True, f"{name}: {node.get('InstanceType') or node.get('machineType')}, {len(node)} keys")


def _violations(value: Any, schema: Any, path: str) -> Iterator[tuple[str, str]]:
    """Keys and values that the schema does not allow, each with a remedy.

    ``schema``: a table, a list with the schema of its items, or the name of a type; see ``clouds``.
    """
    if isinstance(schema, dict):
        if not isinstance(value, dict):
            yield f"{path} = {value!r}", f"write a table of {', '.join(list(schema)[:4])} and so on"
            return
        for key, inner in value.items():
            if key not in schema:
                yield f"{path}.{key}: no such key{nearest(str(key), list(schema))}", "correct it, or leave it out"
            else:
                yield from _violations(inner, schema[key], f"{path}.{key}")
    elif isinstance(schema, list):
        if not isinstance(value, list):
            yield f"{path} = {value!r}", "write a list, as in [...]"
            return
        for number, inner in enumerate(value):
            yield from _violations(inner, schema[0], f"{path}[{number}]")
    elif not _has_type(value, schema):
        words = {"str": "a string, in quotes if it looks like a number", "int": "a whole number", "int64": "a whole number"}
        words |= {"bool": "true or false", "float": "a number", "map": "a table"}
        yield f"{path} = {value!r}", f"write {words[schema]}"


def _has_type(value: Any, kind: str) -> bool:
    if kind == "bool":
        return isinstance(value, bool)
    if isinstance(value, bool):
        return False
    if kind == "int64":
        return isinstance(value, int) or (isinstance(value, str) and value.isdigit())
    kinds: dict[str, type | tuple[type, ...]] = {"str": str, "int": int, "float": (int, float), "map": dict}
    return isinstance(value, kinds[kind])


def _head(config: dict[str, Any]) -> Iterator[Check]:
    commands = " ".join(config.get("head_start_ray_commands") or [])
    if "ray start" not in commands or "--head" not in commands:
        yield Check("head", False, "head_start_ray_commands start no head", "copy them from deploy/clusters/onprem.yaml")
        return
    if "--num-cpus=0" not in commands:
        yield Check("head", None, "workers will run on it, beside the learner", "give its `ray start` --num-cpus=0")
    types = config.get("available_node_types") or {}
    node = (types.get(config.get("head_node_type")) or {}).get("node_config") or {}
    spot = node.get("InstanceMarketOptions") or (node.get("scheduling") or {}).get("provisioningModel") == "SPOT"
    if spot or (isinstance(node.get("scheduling"), dict) and node["scheduling"].get("preemptible")):
        yield Check(
            "head",
            None,
            "is a spot instance: the run ends when the cloud stops it",
            "use on-demand for the head, spot for workers",
        )


def _workers(config: dict[str, Any]) -> Check:
    """The number of worker nodes: ``min_workers``, because a run waits for nodes and does not request any from Ray."""
    name = "workers"
    if config["provider"]["type"] == "local":
        count = len(config["provider"].get("worker_ips") or [])
        return Check(name, count > 0, f"{count} nodes", "" if count else "list them in provider.worker_ips")
    types = config.get("available_node_types") or {}
    kinds = [kind for other, kind in types.items() if other != config.get("head_node_type")]
    most = int(config.get("max_workers", 2))  # Ray's default, for the cluster and for types without their own value
    low = sum(int(kind.get("min_workers", 0)) for kind in kinds)
    high = min(most, sum(int(kind.get("max_workers", most)) for kind in kinds))
    if not low:
        remedy = "set min_workers and max_workers of a node type that is not the head's"
        return Check(name, False, f"none; up to {high} if something requested them" if high else "none", remedy)
    if low < high:
        value = f"{low} nodes; nothing requests the {high - low} more that max_workers allows"
        return Check(name, None, value, "set min_workers to the number that you want")
    return Check(name, True, f"{low} nodes")


def _mounts(config: dict[str, Any], root: Path) -> Iterator[Check]:
    mounts = {str(target): str(source) for target, source in (config.get("file_mounts") or {}).items()}
    paths = {t: root / os.path.expanduser(source) for t, source in mounts.items()}  # noqa: PTH111 (it accepts a missing home)
    for target, name, remedy in (
        ("~/.ray/auth_token", "Ray's token", "ray get-auth-token --generate"),
        ("~/.icrl/certificates", "certificates", "deploy/zenoh/certificates.sh ~/.icrl/certificates HEAD"),
    ):
        if target not in paths:
            yield Check(name, False, f"file_mounts has no {target}", f"add {target}: {target}")
        elif not paths[target].exists():
            yield Check(name, False, f"no {mounts[target]} here", remedy)
        else:
            yield Check(name, True, f"{mounts[target]} is copied to every node")
    missing = [s for t, s in mounts.items() if not paths[t].exists() and not t.startswith(("~/.ray/", "~/.icrl/"))]
    if missing:
        remedy = "pip wheel --no-deps --wheel-dir dist ." if "dist" in missing else "run it from the root of the checkout"
        yield Check("file_mounts", False, f"no {', '.join(missing)} in {root}", remedy)
    wheels = sorted(path for folder in paths.values() if folder.is_dir() for path in folder.glob("icrl_dist-*.whl"))
    if "dist" in mounts.values() and "dist" not in missing:
        yield _wheel(wheels)


def _wheel(wheels: list[Path]) -> Check:
    build = "rm -rf dist && pip wheel --no-deps --wheel-dir dist ."
    if len(wheels) != 1:
        return Check("wheel", False, f"{len(wheels)} wheels of icrl-dist in dist, instead of one", build)
    try:
        packed = version.digest_of_wheel(wheels[0])
    except (OSError, zipfile.BadZipFile) as error:
        return Check("wheel", False, f"{wheels[0].name}: {error}", build)
    if packed != version.digest():
        return Check("wheel", False, f"{wheels[0].name} holds code {packed[:8]}, this is {version.digest()[:8]}", build)
    *_, platforms = wheels[0].stem.rpartition("-")
    if not any(platform == "any" or "linux" in platform for platform in platforms.split(".")):
        remedy = f"build it on Linux, on a processor as the nodes have: {build}"
        return Check("wheel", False, f"{wheels[0].name} cannot be installed on nodes, which run Linux", remedy)
    with zipfile.ZipFile(wheels[0]) as archive:
        compiled = any(Path(name).match("icrl_dist/models/_decoder_kernel*.so") for name in archive.namelist())
    if not compiled:
        value = f"{wheels[0].name} has no compiled decoder: torch computes decisions, which takes several times as long"
        return Check("wheel", None, value, f"install a C compiler, then {build}")
    return Check("wheel", True, f"{wheels[0].name}, code {packed[:8]}, for nodes with {platforms}")


def _commands(config: dict[str, Any]) -> Iterator[Check]:
    starts = {name: " ".join(config.get(f"{name}_start_ray_commands") or []) for name in ("head", "worker")}
    for name, words in starts.items():
        if "ulimit -n" not in words:
            yield Check(
                "open files", None, f"{name}_start_ray_commands do not raise the limit", "start with ulimit -n $(ulimit -Hn);"
            )
    if "RAY_AUTH_MODE=token" not in json.dumps(config) and not config.get("docker"):  # the image sets it
        yield Check(
            "Ray's token", False, "no command sets RAY_AUTH_MODE=token", "export it in ~/.bashrc, as in deploy/clusters/"
        )
    if "--include-dashboard=true" in starts["head"] and "RAY_JOB_STOP_WAIT_TIME_S" not in json.dumps(config):
        yield Check(
            "ray job stop",
            None,
            "kills a run after 3 s, even if its checkpoint is not written yet",
            "export RAY_JOB_STOP_WAIT_TIME_S=60 before the head's ray start",
        )
    if "niceness" not in starts["worker"] and not config.get("docker"):
        yield Check(
            "niceness", None, "Ray runs workers at nice 15", "export RAY_worker_niceness=0 before the worker's ray start"
        )


def _container(config: dict[str, Any]) -> Iterator[Check]:
    docker = config.get("docker") or {}
    if not docker:
        return
    commands = {name: " ".join(config.get(name) or []) for name in ("setup_commands", "head_setup_commands")}
    used = [name for name, words in commands.items() if ".venv/" in words]
    remedy = "leave both empty, as in setup_commands: []; deploy/Dockerfile already contains what they install"
    if "-m venv" in commands["setup_commands"]:
        yield Check("container", None, f"{' and '.join(used)} install again what the image contains", remedy)
    elif used:
        yield Check("container", False, f"{used[0]} call .venv/bin/pip, which the image does not contain", remedy)
    options = " ".join(docker.get("run_options") or [])
    for option in ("--shm-size", "--ulimit nofile"):
        if option not in options:
            yield Check("container", None, f"docker.run_options without {option}", "--shm-size=2g --ulimit nofile=65536:65536")


def _filled_in(config: dict[str, Any]) -> Check:
    """Whether every example value has been replaced; the example values are no real node or account."""
    left = sorted({value for value in _strings(config) if _is_example(value)})
    if left:
        return Check("values", False, f"still example values: {', '.join(left)}", "replace them before ray up")
    return Check("values", True, "no example value is left")


def _strings(value: Any) -> Iterator[str]:
    if isinstance(value, dict):
        for inner in value.values():
            yield from _strings(inner)
    elif isinstance(value, list):
        for inner in value:
            yield from _strings(inner)
    elif isinstance(value, str):
        yield value


def _is_example(value: str) -> bool:
    try:
        return ipaddress.ip_address(value) in _DOCUMENTATION
    except ValueError:
        return value in _PLACEHOLDERS or value.startswith(_PLACEHOLDERS[2:])
