"""Cluster files before `ray up`: the shipped files pass, and each mistake is refused by name with a remedy."""

import copy
import json
import re
import zipfile
from pathlib import Path
from typing import Any

import pytest
import yaml

from icrl_dist import __version__, version
from icrl_dist.cli import main
from icrl_dist.cli.exit_codes import FAILED, OK, USAGE
from icrl_dist.diagnostics import cluster_file
from icrl_dist.diagnostics.checks import table
from icrl_dist.diagnostics.doctor import diagnose_file
from tests.optional import known

TAG, COMPILED = "cp311-abi3-linux_x86_64", "icrl_dist/models/_decoder_kernel.abi3.so"
ROOT = Path(__file__).parents[2]
SHIPPED = ("onprem", "aws", "gcp")
WORKER = ("available_node_types", "worker", "node_config")


@pytest.fixture
def checkout(tmp_path, monkeypatch):
    """A folder like a checkout in which `ray up` can be run: a token, certificates, and a wheel of this code."""
    home, root = tmp_path / "home", tmp_path / "checkout"
    for file in (home / ".ray" / "auth_token", home / ".icrl" / "certificates" / "ca.pem"):
        file.parent.mkdir(parents=True)
        file.write_text("x")
    (root / "dist").mkdir(parents=True)
    for name in ("pyproject.toml", "constraints.txt", "README.md", *version.PACKAGES):
        (root / name).symlink_to(ROOT / name)
    with zipfile.ZipFile(root / "dist" / f"icrl_dist-{__version__}-{TAG}.whl", "w") as wheel:
        wheel.writestr(COMPILED, "")
        for package in version.PACKAGES:
            for file in (ROOT / package).rglob("*"):
                if file.suffix in (".c", ".h", ".py", ".toml", ".npz"):
                    wheel.write(file, file.relative_to(ROOT))
    monkeypatch.setenv("HOME", str(home))
    return root


@pytest.fixture
def diagnosed(checkout, tmp_path):
    """``diagnosed(config)``: the failed checks and the warnings of the doctor, as lines."""

    def diagnose(config):
        file = tmp_path / "cluster.yaml"
        file.write_text(yaml.safe_dump(config))
        checks = diagnose_file(file, checkout)
        return [table([c]) for c in checks if c.ok is False], [table([c]) for c in checks if c.ok is None]

    return diagnose


def shipped(name):
    return yaml.safe_load((ROOT / "deploy" / "clusters" / f"{name}.yaml").read_text())


def filled_in(value):
    """The same configuration without example values."""
    if isinstance(value, dict):
        return {key: filled_in(inner) for key, inner in value.items()}
    if isinstance(value, list):
        return [filled_in(inner) for inner in value]
    return "10.0.0.1" if isinstance(value, str) and cluster_file._is_example(value) else value


def with_value(config, path, value):
    changed = copy.deepcopy(config)
    inner = changed
    for key in path[:-1]:
        inner = inner[key]
    inner[path[-1]] = value
    return changed


@pytest.mark.parametrize("name", SHIPPED)
def test_a_shipped_file_passes_once_its_example_values_are_replaced(diagnosed, name):
    stops, warns = diagnosed(shipped(name))
    assert not warns
    assert len(stops) == 1 and "still example values" in stops[0], stops
    assert diagnosed(filled_in(shipped(name))) == ([], [])


@pytest.mark.parametrize(("name", "user"), [("aws", {"auth"}), ("gcp", set())])
def test_only_two_sections_need_edits(name, user):
    """All marks are in provider or available_node_types; for AWS also in auth, because the user depends on the image."""
    text = (ROOT / "deploy" / "clusters" / f"{name}.yaml").read_text()
    marked = [m.start() for m in re.finditer(r"# .*<--|# <--", text)][1:]  # the first one explains the mark
    sections = [re.findall(r"^(\w+):", text[:place], re.MULTILINE)[-1] for place in marked]
    assert len(marked) > 5 and set(sections) == {"provider", "available_node_types"} | user


@pytest.mark.parametrize("name", ("aws", "gcp"))
def test_the_commented_container_section_passes_too(diagnosed, name):
    text = (ROOT / "deploy" / "clusters" / f"{name}.yaml").read_text()
    container = known(re.search(r"^# docker:\n(#   .*\n)+", text, re.MULTILINE))[0]
    config = filled_in(yaml.safe_load(text.replace(container, re.sub(r"^# ", "", container, flags=re.MULTILINE))))
    assert config["docker"]["image"]
    stops, warns = diagnosed(config)
    assert not stops and any("install again what the image contains" in line for line in warns)
    config["setup_commands"] = []
    assert any(
        "head_setup_commands call .venv/bin/pip, which the image does not contain" in line for line in diagnosed(config)[0]
    )
    config["head_setup_commands"] = []
    assert diagnosed(config) == ([], [])
    config["docker"]["run_options"] = []
    assert any("--shm-size" in line for line in diagnosed(config)[1])


def test_the_image_contains_what_the_head_would_install():
    image = (ROOT / "deploy" / "Dockerfile").read_text()
    for name in ("aws", "gcp"):
        (command,) = shipped(name)["head_setup_commands"]
        assert all(package in image for package in command.split("--quiet ")[1].split())


MISTAKES = [
    ("aws", (*WORKER, "InstanceTyp"), "c7i.4xlarge", r"worker.node_config.InstanceTyp: no such key.*InstanceType"),
    ("aws", (*WORKER, "InstanceType"), 4, r"worker.node_config.InstanceType = 4 .*write a string"),
    ("aws", (*WORKER, "SubnetIds"), "subnet-1", r"SubnetIds = 'subnet-1' .*write a list"),
    ("aws", (*WORKER, "InstanceMarketOptions"), {"Market": "spot"}, r"InstanceMarketOptions.Market: no such key.*MarketType"),
    ("aws", (*WORKER, "EbsOptimized"), "yes", r"EbsOptimized = 'yes' .*true or false"),
    ("aws", WORKER, {"ImageId": "ami-1"}, "worker.node_config without InstanceType"),
    ("gcp", (*WORKER, "machinetype"), "n2-highcpu-16", r"machinetype: no such key.*machineType"),
    ("gcp", (*WORKER, "machineType"), 16, r"worker.node_config.machineType = 16 .*write a string"),
    ("gcp", (*WORKER, "scheduling"), [{"preemptible": True}], r"scheduling = .*write a table"),
    ("gcp", (*WORKER, "disks", 0, "initializeParams", "diskSizeGb"), "fifty", r"diskSizeGb = 'fifty' .*whole number"),
    ("gcp", (*WORKER, "disks", 0, "initializeParams", "diskSize"), 50, r"diskSize: no such key"),
    ("gcp", WORKER, {"machineType": "n2-highcpu-16"}, "worker.node_config without disks"),
    ("aws", ("setup_comands",), [], r"Ray's schema.*setup_comands"),
    (
        "gcp",
        ("available_node_types", "worker", "min_workers"),
        "four",
        r"Ray's schema  available_node_types.worker.min_workers",
    ),
    ("aws", ("head_node_type",), "haed", r"Ray's schema.*head_node_type"),
    ("aws", ("provider", "availability_zone"), "eu-west-1a", "zone eu-west-1a is not in region us-west-2"),
    ("gcp", ("provider", "project_id"), "", "gcp without project_id"),
    ("aws", ("file_mounts", "~/icrl-dist/dist"), "wheels", r"no wheels in"),
    ("aws", (*WORKER[:2], "min_workers"), 0, r"none; up to 4 if something requested.*min_workers"),
    ("aws", (*WORKER[:2], "max_workers"), "four", r"Ray's schema"),
    ("onprem", ("file_mounts",), {}, r"file_mounts has no ~/.ray/auth_token"),
    ("onprem", ("head_start_ray_commands",), ["ray stop"], "start no head"),
    ("onprem", ("setup_commands",), ["true"], "no command sets RAY_AUTH_MODE=token"),
]


@pytest.mark.parametrize(("name", "path", "value", "message"), MISTAKES)
def test_a_mistake_is_refused_by_name(diagnosed, name, path, value, message):
    stops, _ = diagnosed(with_value(shipped(name), path, value))
    assert any(re.search(message, line) and "  -> " in line for line in stops), stops


@pytest.mark.parametrize(
    ("name", "path", "value", "message"),
    [
        ("aws", ("available_node_types", "head", "node_config", "InstanceMarketOptions"), {"MarketType": "spot"}, "is a spot"),
        ("gcp", (*WORKER[:2], "min_workers"), 3, "3 nodes; nothing requests the 1 more that max_workers allows"),
        ("aws", ("provider", "availability_zone"), "us-west-2a, us-west-2b", "name one"),
        ("onprem", ("worker_start_ray_commands",), ["ray start --address=$RAY_HEAD_IP:6379"], "ulimit"),
        (
            "onprem",
            ("head_start_ray_commands",),
            ["ulimit -n 9999; ray start --head --num-cpus=0 --include-dashboard=true"],
            "kills a run after 3 s",
        ),
    ],
)
def test_a_setting_that_starts_but_may_fail_later_is_a_warning(diagnosed, name, path, value, message):
    stops, warns = diagnosed(with_value(filled_in(shipped(name)), path, value))
    assert not stops and any(message in line for line in warns), (stops, warns)


def test_a_type_without_max_workers_has_the_cluster_default(diagnosed):
    config = filled_in(shipped("aws"))
    del config["available_node_types"]["worker"]["max_workers"]
    assert diagnosed(config) == ([], [])


def test_a_wheel_of_other_code_is_refused(diagnosed, checkout):
    (wheel,) = (checkout / "dist").glob("*.whl")
    with zipfile.ZipFile(wheel, "a") as archive:
        archive.writestr("actors/more.py", "")
    assert any("holds code" in line and version.digest()[:8] in line for line in diagnosed(shipped("aws"))[0])
    wheel.write_text("no zip")
    assert any("not a zip" in line for line in diagnosed(shipped("aws"))[0])
    wheel.unlink()
    assert any("0 wheels" in line for line in diagnosed(shipped("aws"))[0])


def test_a_wheel_of_another_system_is_refused_and_one_without_a_compiled_decoder_is_a_warning(diagnosed, checkout):
    (wheel,) = (checkout / "dist").glob("*.whl")
    mac = wheel.rename(wheel.with_name(wheel.name.replace("linux_x86_64", "macosx_14_0_arm64")))
    (line,) = [line for line in diagnosed(shipped("aws"))[0] if "wheel" in line]
    assert "macosx_14_0_arm64.whl cannot be installed on nodes, which run Linux  -> build it on Linux" in line
    with zipfile.ZipFile(mac) as archive, zipfile.ZipFile(wheel, "w") as other:
        for name in archive.namelist():
            if name != COMPILED:
                other.writestr(name, archive.read(name))
    mac.unlink()
    (line,) = [line for line in diagnosed(shipped("aws"))[1] if "wheel" in line]
    assert "has no compiled decoder" in line and "install a C compiler" in line


@pytest.mark.parametrize(("text", "message"), [(None, "cannot be read"), ("[1", "not YAML"), ("a: 1", "no cluster file")])
def test_a_file_that_is_no_cluster_file_is_bad_usage(tmp_path, capsys, text, message):
    file = tmp_path / "file.yaml"
    if text is not None:
        file.write_text(text)
    assert main.main(["doctor", "--cluster", str(file)]) == USAGE
    (line,) = capsys.readouterr().err.splitlines()
    assert message in line and str(file) in line


def test_the_exit_code_shows_whether_a_run_could_start(checkout, monkeypatch, capsys, tmp_path):
    monkeypatch.chdir(checkout)
    assert main.main(["doctor", "--cluster", str(ROOT / "deploy/clusters/gcp.yaml")]) == FAILED
    file = tmp_path / "mine.yaml"
    file.write_text(yaml.safe_dump(filled_in(shipped("gcp"))))
    assert main.main(["doctor", "--cluster", str(file)]) == OK
    assert "n2-highcpu-16" in capsys.readouterr().out
    file = tmp_path / "mistake.yaml"
    file.write_text(yaml.safe_dump(with_value(shipped("gcp"), (*WORKER, "machineType"), 16)))
    assert main.main(["doctor", "--cluster", str(file)]) == FAILED


def test_schemas_accept_the_keys_of_rays_example_files():
    """A schema that refused these keys would be out of date."""
    schema = json.loads((ROOT / "icrl_dist/diagnostics/clouds/aws.json").read_text())
    node: dict[str, Any] = {
        "InstanceType": "m5.large",
        "BlockDeviceMappings": [{"DeviceName": "/dev/sda1", "Ebs": {"VolumeSize": 256}}],
    }
    node |= {"InstanceMarketOptions": {"MarketType": "spot", "SpotOptions": {"MaxPrice": "0.1"}}, "SubnetIds": ["subnet-1"]}
    assert list(cluster_file._violations(node, schema, "")) == []
