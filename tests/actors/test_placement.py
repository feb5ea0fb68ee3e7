"""Placement of workers on nodes that join and leave, and reports about nodes that do not join."""

import os
import socket

import pytest

from actors import missing, placement
from actors.placement import Node, Placement
from icrl_dist.config.run import ConfigError
from icrl_dist.launch import train, whole_run
from icrl_dist.launch.learner_process import TrainFailed
from tests.optional import known


def node(name, cores=2):
    return Node(name, f"10.0.0.{ord(name)}", name, cores)


def workers_by_node(placement):
    return {name: sorted(m.workers) for name, m in placement.nodes.items()}


def test_workers_are_spread_by_the_share_of_free_cores():
    placement = Placement(4)
    placement.join(node("a", 6))
    placement.join(node("b", 2))
    assert [(worker, m.node_id) for worker, m in placement.assign()] == [(0, "a"), (1, "b"), (2, "a"), (3, "a")]
    assert placement.assign() == [] and placement.capacity == 8


def test_without_a_number_every_core_gets_a_worker_also_on_later_nodes():
    placement = Placement(None)
    placement.join(node("a", 1))
    assert len(placement.assign()) == 1
    placement.join(node("b", 3))
    placement.assign()
    assert workers_by_node(placement) == {"a": [0], "b": [1, 2, 3]}


def test_workers_of_a_lost_node_wait_for_another_and_keep_their_numbers():
    placement = Placement(3)
    placement.join(node("a"))
    placement.join(node("b", 1))
    placement.assign()
    lost = placement.leave("a")
    assert len(lost) == 2 and placement.waiting == sorted(lost) and placement.assign() == []
    assert placement.leave("a") == set()
    placement.join(node("c", 1))
    assert [worker for worker, _ in placement.assign()] == [min(lost)]
    assert placement.waiting == [max(lost)] and placement.node_of(max(lost)) is None
    assert known(placement.node_of(min(lost))).node_id == "c"


def test_the_summary_is_one_line():
    placement = Placement(6)
    placement.join(node("a", 5))
    placement.join(node("b", 1))
    placement.assign()
    assert (
        placement.summary(lambda i: "w1-1" if i == 1 else f"w{i}") == "a (10.0.0.97): w0 to w5, 5 workers; b (10.0.0.98): w1-1"
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


def test_a_missing_node_is_reported_with_the_last_lines_of_its_log(logs):
    expected = missing.ExpectedNodes(("10.0.0.2", "10.0.0.3", "10.0.0.4"), 3)
    first, second = missing.report(expected, {"10.0.0.4"}, logs)
    assert first == "10.0.0.2 has not joined: ssh: connect to host 10.0.0.2 port 22: No route to host"
    assert second.startswith("10.0.0.3 has not joined: Ray's log does not mention it")
    assert missing.report(expected, expected.addresses, logs) == []


def test_a_node_that_the_file_lists_by_name_is_found_by_its_address(logs, monkeypatch):
    addresses = {"one": "10.0.0.2", "10.0.0.3": "10.0.0.3"}

    def resolve(name, port):
        if name not in addresses:
            raise OSError(name)
        return [(2, 1, 6, "", (addresses[name], 0))]

    monkeypatch.setattr(socket, "getaddrinfo", resolve)
    expected = missing.ExpectedNodes(("one", "10.0.0.3", "unknown"), 3)
    (line,) = missing.report(expected, {"10.0.0.2", "10.0.0.3"}, logs)
    assert line.startswith("unknown has not joined")


def test_cloud_nodes_have_no_addresses_so_they_are_counted(logs):
    (line,) = missing.report(missing.ExpectedNodes((), 4), {"172.16.0.9"}, logs)
    assert line.startswith("3 of 4 nodes have not joined: ") and "MaxSpotInstanceCountExceeded" in line
    assert missing.report(missing.ExpectedNodes(), set(), logs) == []


def test_expected_nodes_are_read_from_the_cluster_file(tmp_path):
    file = tmp_path / "ray_bootstrap_config.yaml"
    assert missing.expected(file) == missing.ExpectedNodes()
    file.write_text("provider: {type: local, head_ip: a, worker_ips: [10.0.0.2, 10.0.0.3]}")
    assert missing.expected(file) == missing.ExpectedNodes(("10.0.0.2", "10.0.0.3"), 2)
    kinds = "available_node_types: {head: {min_workers: 0}, worker: {min_workers: 3}, spot: {min_workers: 2}}"
    file.write_text(f"provider: {{type: aws}}\nhead_node_type: head\n{kinds}")
    assert missing.expected(file) == missing.ExpectedNodes((), 5)
    file.write_text("[")
    assert missing.expected(file) == missing.ExpectedNodes()


@pytest.mark.parametrize(("cores", "workers"), [(1, 1), (2, 2), (8, 2)])
def test_a_process_on_one_core_starts_one_worker(monkeypatch, cores, workers):
    monkeypatch.setattr(os, "sched_getaffinity", lambda pid: set(range(cores)))
    assert placement.local_actors() == workers
    placement.check_cores(placement.local_actors())
    with pytest.raises(ConfigError, match=rf"--actors {cores + 1}: this machine has {cores} cores?\b"):
        placement.check_cores(cores + 1)


def test_a_run_without_a_number_of_workers_begins_on_one_core(module_run, monkeypatch, tmp_path):
    monkeypatch.setattr(os, "sched_getaffinity", lambda pid: {0})
    asked = list[int | None]()

    def started(run, folder, actors, *rest):
        asked.append(actors)
        raise TrainFailed("far enough")

    monkeypatch.setattr(train, "train_ray", started)
    with pytest.raises(TrainFailed):
        whole_run.train(module_run, tmp_path / "run")
    assert asked == [1]
