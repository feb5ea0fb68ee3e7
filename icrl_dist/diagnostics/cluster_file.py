"""A cluster file for ``ray up``, looked through before it costs anything: what Ray itself does not look at.

Ray's own schema knows nothing of what stands inside ``node_config``, nor of what a run of ours
needs on the machines.  Nothing here asks a cloud or a machine.
"""

from __future__ import annotations

import ipaddress
import json
import zipfile
from collections.abc import Iterator
from importlib import resources
from pathlib import Path
from typing import Any

import yaml

from icrl_dist import version
from icrl_dist.config.run import ConfigError
from icrl_dist.config.toml import nearest
from icrl_dist.diagnostics.checks import Finding

_REQUIRED = {"aws": ("InstanceType", "ImageId"), "gcp": ("machineType", "disks")}
_PLACEHOLDERS = ("ami-00000000000000000", "PROJECT", "projects/PROJECT/", "REGISTRY/")
_DOCUMENTATION = ipaddress.ip_network("192.0.2.0/24")


def load(file: Path) -> dict[str, Any]:
    """The file as a dictionary.  Raises ConfigError if it cannot be read or is not one."""
    try:
        found = yaml.safe_load(file.read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigError(
            f"--cluster {file}: cannot be read ({error}); name a file such as deploy/clusters/onprem.yaml"
        ) from None
    except yaml.YAMLError as error:
        raise ConfigError(f"--cluster {file}: not YAML: {' '.join(str(error).split())}") from None
    if not isinstance(found, dict) or not isinstance(found.get("provider"), dict):
        raise ConfigError(f"--cluster {file}: no cluster file, for it has no provider; begin with deploy/clusters/onprem.yaml")
    return found


def findings(config: dict[str, Any], root: Path) -> list[Finding]:
    """What speaks for and against the file; local paths in it are taken from ``root``, where ``ray up`` is run."""
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


def _provider(config: dict[str, Any]) -> Iterator[Finding]:
    provider = config["provider"]
    kind = provider.get("type")
    if kind not in ("local", *_REQUIRED):
        yield Finding(
            "provider", None, f"type {kind}: only local, aws and gcp are known here", "look its node_config up yourself"
        )
        return
    wrong = [
        k
        for k in ("region", "availability_zone", *(["project_id"] * (kind == "gcp")))
        if kind != "local" and not provider.get(k)
    ]
    zones = [zone.strip() for zone in str(provider.get("availability_zone", "")).split(",") if zone.strip()]
    elsewhere = [zone for zone in zones if not zone.startswith(str(provider.get("region")))]
    if wrong:
        yield Finding("provider", False, f"{kind} without {', '.join(wrong)}", f"say provider.{wrong[0]}")
    elif kind != "local" and elsewhere:
        yield Finding("provider", False, f"zone {elsewhere[0]} is not in region {provider['region']}", "change one of the two")
    elif len(zones) > 1:
        yield Finding("provider", None, f"zones {', '.join(zones)}", "name one: traffic between zones is slower and paid for")
    else:
        yield Finding("provider", True, f"{kind}{' ' + zones[0] if zones else ''}")


def _node_configs(cloud: str, config: dict[str, Any]) -> Iterator[Finding]:
    shape = json.loads((resources.files("icrl_dist.diagnostics.clouds") / f"{cloud}.json").read_text())
    for name, kind in (config.get("available_node_types") or {}).items():
        node = kind.get("node_config") or {}
        missing = [key for key in _REQUIRED[cloud] if key not in node]
        errors = [*_misfits(node, shape, f"{name}.node_config")]
        errors += [(f"{name}.node_config without {key}", "say which") for key in missing]
        for value, remedy in errors:
            yield Finding("node_config", False, value, remedy)
        if not errors:
            yield Finding(
                "node_config", True, f"{name}: {node.get('InstanceType') or node.get('machineType')}, {len(node)} keys"
            )


def _misfits(value: Any, shape: Any, where: str) -> Iterator[tuple[str, str]]:
    """Keys and values that the shape does not have, each with a remedy."""
    if isinstance(shape, dict):
        if not isinstance(value, dict):
            yield f"{where} = {value!r}", f"write a table of {', '.join(list(shape)[:4])} and so on"
            return
        for key, inner in value.items():
            if key not in shape:
                yield f"{where}.{key}: no such key{nearest(str(key), list(shape))}", "correct it, or leave it out"
            else:
                yield from _misfits(inner, shape[key], f"{where}.{key}")
    elif isinstance(shape, list):
        if not isinstance(value, list):
            yield f"{where} = {value!r}", "write a list, as in [...]"
            return
        for number, inner in enumerate(value):
            yield from _misfits(inner, shape[0], f"{where}[{number}]")
    elif not _fits(value, shape):
        words = {"str": "text, in quotes if it looks like a number", "int": "a whole number", "int64": "a whole number"}
        words |= {"bool": "true or false", "float": "a number", "map": "a table"}
        yield f"{where} = {value!r}", f"write {words[shape]}"


def _fits(value: Any, kind: str) -> bool:
    if kind == "bool":
        return isinstance(value, bool)
    if isinstance(value, bool):
        return False
    if kind == "int64":
        return isinstance(value, int) or (isinstance(value, str) and value.isdigit())
    kinds: dict[str, type | tuple[type, ...]] = {"str": str, "int": int, "float": (int, float), "map": dict}
    return isinstance(value, kinds[kind])


def _head(config: dict[str, Any]) -> Iterator[Finding]:
    started = " ".join(config.get("head_start_ray_commands") or [])
    if "ray start" not in started or "--head" not in started:
        yield Finding("head", False, "head_start_ray_commands start no head", "take them from deploy/clusters/onprem.yaml")
        return
    if "--num-cpus=0" not in started:
        yield Finding("head", None, "workers will be placed on it, beside the learner", "give its `ray start` --num-cpus=0")
    types = config.get("available_node_types") or {}
    node = (types.get(config.get("head_node_type")) or {}).get("node_config") or {}
    spot = node.get("InstanceMarketOptions") or (node.get("scheduling") or {}).get("provisioningModel") == "SPOT"
    if spot or (isinstance(node.get("scheduling"), dict) and node["scheduling"].get("preemptible")):
        yield Finding(
            "head", None, "is a spot instance: the run stops when it is taken", "pay for the head; spot is for workers"
        )


def _workers(config: dict[str, Any]) -> Finding:
    """How many machines there will be: as many as there are at least, for a run waits for machines and asks for none."""
    name = "workers"
    if config["provider"]["type"] == "local":
        count = len(config["provider"].get("worker_ips") or [])
        return Finding(name, count > 0, f"{count} machines", "" if count else "name some in provider.worker_ips")
    types = config.get("available_node_types") or {}
    kinds = [kind for other, kind in types.items() if other != config.get("head_node_type")]
    most = int(config.get("max_workers", 2))  # Ray's, for the cluster and for a type that does not say
    low = sum(int(kind.get("min_workers", 0)) for kind in kinds)
    high = min(most, sum(int(kind.get("max_workers", most)) for kind in kinds))
    if not low:
        remedy = "say min_workers and max_workers of a node type that is not the head's"
        return Finding(name, False, f"none; up to {high} if anything asked for them" if high else "none", remedy)
    if low < high:
        said = f"{low} machines, and nothing asks for the {high - low} more that max_workers allows"
        return Finding(name, None, said, "say min_workers as many as you want")
    return Finding(name, True, f"{low} machines")


def _mounts(config: dict[str, Any], root: Path) -> Iterator[Finding]:
    mounts = {str(target): str(source) for target, source in (config.get("file_mounts") or {}).items()}
    there = {target: root / Path(source).expanduser() for target, source in mounts.items()}
    for target, what, remedy in (
        ("~/.ray/auth_token", "Ray's token", "ray get-auth-token --generate"),
        ("~/.icrl/certificates", "certificates", "deploy/zenoh/certificates.sh ~/.icrl/certificates HEAD"),
    ):
        if target not in there:
            yield Finding(what, False, f"file_mounts has no {target}", f"add {target}: {target}")
        elif not there[target].exists():
            yield Finding(what, False, f"no {mounts[target]} here", remedy)
        else:
            yield Finding(what, True, f"{mounts[target]} is copied to every machine")
    missing = [s for t, s in mounts.items() if not there[t].exists() and not t.startswith(("~/.ray/", "~/.icrl/"))]
    if missing:
        remedy = "pip wheel --no-deps --wheel-dir dist ." if "dist" in missing else "run it from the root of the checkout"
        yield Finding("file_mounts", False, f"no {', '.join(missing)} in {root}", remedy)
    wheels = sorted(path for place in there.values() if place.is_dir() for path in place.glob("icrl_dist-*.whl"))
    if "dist" in mounts.values() and "dist" not in missing:
        yield _wheel(wheels)


def _wheel(wheels: list[Path]) -> Finding:
    build = "rm -rf dist && pip wheel --no-deps --wheel-dir dist ."
    if len(wheels) != 1:
        return Finding("wheel", False, f"{len(wheels)} wheels of icrl-dist in dist, not one", build)
    try:
        there = version.digest_of_wheel(wheels[0])
    except (OSError, zipfile.BadZipFile) as error:
        return Finding("wheel", False, f"{wheels[0].name}: {error}", build)
    if there != version.digest():
        return Finding("wheel", False, f"{wheels[0].name} holds code {there[:8]}, this is {version.digest()[:8]}", build)
    return Finding("wheel", True, f"{wheels[0].name}, code {there[:8]}")


def _commands(config: dict[str, Any]) -> Iterator[Finding]:
    starts = {name: " ".join(config.get(f"{name}_start_ray_commands") or []) for name in ("head", "worker")}
    for name, words in starts.items():
        if "ulimit -n" not in words:
            yield Finding(
                "open files", None, f"{name}_start_ray_commands leave the limit as it is", "begin with ulimit -n $(ulimit -Hn);"
            )
    if "RAY_AUTH_MODE=token" not in json.dumps(config) and not config.get("docker"):  # the image sets it
        yield Finding(
            "Ray's token", False, "no command sets RAY_AUTH_MODE=token", "export it in ~/.bashrc, as in deploy/clusters/"
        )
    if "--include-dashboard=true" in starts["head"] and "RAY_JOB_STOP_WAIT_TIME_S" not in json.dumps(config):
        yield Finding(
            "ray job stop",
            None,
            "kills a run after 3 s, whether its checkpoint is written or not",
            "export RAY_JOB_STOP_WAIT_TIME_S=60 before the head's ray start",
        )
    if "niceness" not in starts["worker"] and not config.get("docker"):
        yield Finding(
            "niceness", None, "Ray's workers run at nice 15", "export RAY_worker_niceness=0 before the worker's ray start"
        )


def _container(config: dict[str, Any]) -> Iterator[Finding]:
    docker = config.get("docker") or {}
    if not docker:
        return
    commands = {name: " ".join(config.get(name) or []) for name in ("setup_commands", "head_setup_commands")}
    used = [name for name, words in commands.items() if ".venv/" in words]
    remedy = "leave both empty, as in setup_commands: [], for deploy/Dockerfile has what they install"
    if "-m venv" in commands["setup_commands"]:
        yield Finding("container", None, f"{' and '.join(used)} install once more what its image has", remedy)
    elif used:
        yield Finding("container", False, f"{used[0]} call .venv/bin/pip, which is not in the image", remedy)
    options = " ".join(docker.get("run_options") or [])
    for option in ("--shm-size", "--ulimit nofile"):
        if option not in options:
            yield Finding(
                "container", None, f"docker.run_options without {option}", "--shm-size=2g --ulimit nofile=65536:65536"
            )


def _filled_in(config: dict[str, Any]) -> Finding:
    """Whether every example value has been changed; an example is never a machine's or an account's own."""
    left = sorted({value for value in _texts(config) if _example(value)})
    if left:
        return Finding("values", False, f"still the example's: {', '.join(left)}", "fill them in before ray up")
    return Finding("values", True, "no example value is left")


def _texts(value: Any) -> Iterator[str]:
    if isinstance(value, dict):
        for inner in value.values():
            yield from _texts(inner)
    elif isinstance(value, list):
        for inner in value:
            yield from _texts(inner)
    elif isinstance(value, str):
        yield value


def _example(value: str) -> bool:
    try:
        return ipaddress.ip_address(value) in _DOCUMENTATION
    except ValueError:
        return value in _PLACEHOLDERS or value.startswith(_PLACEHOLDERS[2:])
