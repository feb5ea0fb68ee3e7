"""Workers on machines that come and go, and machines that never come."""

import pytest

from actors import missing
from actors.placement import Machine, Placement


def machine(name, cores=2):
    return Machine(name, f"10.0.0.{ord(name)}", name, cores)


def stands(placement):
    return {name: sorted(m.workers) for name, m in placement.machines.items()}


def test_workers_are_spread_by_the_share_of_cores_that_is_free():
    placement = Placement(4)
    placement.join(machine("a", 6))
    placement.join(machine("b", 2))
    assert [(worker, m.node) for worker, m in placement.settle()] == [(0, "a"), (1, "b"), (2, "a"), (3, "a")]
    assert placement.settle() == [] and placement.room == 8


def test_without_a_number_every_core_gets_one_and_new_machines_more():
    placement = Placement(None)
    placement.join(machine("a", 1))
    assert len(placement.settle()) == 1
    placement.join(machine("b", 3))
    placement.settle()
    assert stands(placement) == {"a": [0], "b": [1, 2, 3]}


def test_who_loses_a_machine_waits_for_room_and_keeps_a_number():
    placement = Placement(3)
    placement.join(machine("a"))
    placement.join(machine("b", 1))
    placement.settle()
    lost = placement.leave("a")
    assert len(lost) == 2 and placement.waiting == sorted(lost) and placement.settle() == []
    assert placement.leave("a") == set()
    placement.join(machine("c", 1))
    assert [worker for worker, _ in placement.settle()] == [min(lost)]
    assert placement.waiting == [max(lost)] and placement.where(max(lost)) is None
    assert placement.where(min(lost)).node == "c"


def test_where_everything_landed_is_one_line():
    placement = Placement(6)
    placement.join(machine("a", 5))
    placement.join(machine("b", 1))
    placement.settle()
    assert (
        placement.landed(lambda i: "w1-1" if i == 1 else f"w{i}") == "a (10.0.0.97): w0 to w5, 5 workers; b (10.0.0.98): w1-1"
    )


@pytest.fixture
def logs(tmp_path):
    lines = [
        "New status: waiting-for-ssh 10.0.0.2",
        "ssh: connect to host 10.0.0.25 port 22: Connection refused",
        "ssh: connect to host 10.0.0.2 port 22: No route to host",
        "ssh: connect to host 10.0.0.2 port 22: No route to host",
        "RunInstances failed: MaxSpotInstanceCountExceeded",
    ]
    (tmp_path / "monitor.out").write_text("\n".join(lines))
    return tmp_path


def test_a_machine_that_is_missing_is_named_with_the_end_of_its_log(logs):
    promised = missing.Expected(("10.0.0.2", "10.0.0.3", "10.0.0.4"), 3)
    first, second = missing.report(promised, {"10.0.0.4"}, logs)
    assert first == "10.0.0.2 has not joined: ssh: connect to host 10.0.0.2 port 22: No route to host"
    assert second.startswith("10.0.0.3 has not joined: its log says nothing of it")
    assert missing.report(promised, promised.addresses, logs) == []


def test_a_machine_that_the_file_has_by_name_is_known_by_its_address(logs, monkeypatch):
    addresses = {"one": "10.0.0.2", "10.0.0.3": "10.0.0.3"}

    def resolve(name, port):
        if name not in addresses:
            raise OSError(name)
        return [(2, 1, 6, "", (addresses[name], 0))]

    monkeypatch.setattr(missing.socket, "getaddrinfo", resolve)
    promised = missing.Expected(("one", "10.0.0.3", "nobody"), 3)
    (line,) = missing.report(promised, {"10.0.0.2", "10.0.0.3"}, logs)
    assert line.startswith("nobody has not joined")


def test_clouds_name_no_machines_so_they_are_counted(logs):
    (line,) = missing.report(missing.Expected((), 4), {"172.16.0.9"}, logs)
    assert line.startswith("3 of 4 machines have not joined: ") and "MaxSpotInstanceCountExceeded" in line
    assert missing.report(missing.Expected(), set(), logs) == []


def test_what_the_cluster_file_promises(tmp_path):
    file = tmp_path / "ray_bootstrap_config.yaml"
    assert missing.expected(file) == missing.Expected()
    file.write_text("provider: {type: local, head_ip: a, worker_ips: [10.0.0.2, 10.0.0.3]}")
    assert missing.expected(file) == missing.Expected(("10.0.0.2", "10.0.0.3"), 2)
    kinds = "available_node_types: {head: {min_workers: 0}, worker: {min_workers: 3}, spot: {min_workers: 2}}"
    file.write_text(f"provider: {{type: aws}}\nhead_node_type: head\n{kinds}")
    assert missing.expected(file) == missing.Expected((), 5)
    file.write_text("[")
    assert missing.expected(file) == missing.Expected()
