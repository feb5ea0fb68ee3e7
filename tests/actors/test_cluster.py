"""Which nodes of a cluster get workers, on a fake Ray."""

import socket

import pytest

from actors import fleet as fleet_module
from icrl_dist.config.run import ConfigError
from tests.actors.fake_ray import LOOPBACK, NEEDED, OWN_FACTS, FakeRay, gather, local_name, new_fleet, placements

__all__ = ["local_name", "new_fleet"]


def test_a_cluster_that_stays_too_small_is_refused(new_fleet, local_name, monkeypatch):
    monkeypatch.setattr(fleet_module, "REPORT_MISSING_S", -1.0)
    monkeypatch.setattr(fleet_module, "JOIN_S", 0.01)
    ray, notes = FakeRay(0, 1), list[str]()
    with pytest.raises(ConfigError, match=r"the cluster at auto has 1 cores for 2 workers .*--actors"):
        gather(new_fleet(ray, 2, expected=(("10.0.0.1", "10.0.0.9"), 2)), notes)
    assert not ray.placed and [n for n in notes if n.startswith("10.0.0.9 has not joined")]


@pytest.mark.parametrize(
    ("answer", "message"),
    [
        ({"version": "0.0.9"}, r"n1 \(10.0.0.1\): icrl-dist 0.0.9 there, .* here: run `ray up` again"),
        ({"code": "f" * 64}, r"icrl-dist's code ffffffff there"),
        ({"versions": {**OWN_FACTS["versions"], "torch": "1.0"}}, r"torch 1.0 there, .* here"),
        ({"python": "3.9.1"}, r"Python 3.9.1 there"),
        (
            {"plugins": {"problems/toy": ["toys", "1.1", "a" * 64]}},
            r"n1 \(10.0.0.1\): problem 'toy': toys 1.1 with code aaaaaaaa there, no other package with it here: run `ray up`",
        ),
        ({"certificates": "/c/worker.key: cannot be read"}, r"n1 \(10.0.0.1\): /c/worker.key"),
        ({"unreached": ["10.0.0.9:7447: timed out"]}, r"cannot reach the learner's port, 10.0.0.9:7447: timed out"),
        (
            {"certificates": "no key", "unreached": ["10.0.0.9:7447: refused"]},
            r"no key; cannot reach .* 10.0.0.9:7447: refused",
        ),
        (ModuleNotFoundError("No module named 'icrl_dist'"), r"10.0.0.1: No module named 'icrl_dist'; run `ray up` again"),
    ],
)
def test_a_node_that_fails_the_check_is_refused_before_the_run_starts(new_fleet, local_name, answer, message):
    ray = FakeRay(0, 2, 2)
    ray.answers["n1"] = answer
    with pytest.raises(ConfigError, match=message) as error:
        gather(new_fleet(ray, 2), [])
    assert not ray.placed and "\n" not in str(error.value)


@pytest.mark.parametrize("kernel", [False, True])
def test_a_node_without_the_compiled_decoder_is_refused_for_runs_that_need_it(new_fleet, local_name, kernel):
    ray = FakeRay(0, 2)
    ray.answers["n1"] = {"decoder": "not compiled: run `make kernel`"}
    fleet = new_fleet(ray, 2)
    if kernel:
        with pytest.raises(
            ConfigError, match=r"^n1 \(10.0.0.1\): context.decoder = 'kernel': not compiled: run `make kernel`$"
        ):
            gather(fleet, [], kernel=True)
    else:
        gather(fleet, [])
        assert fleet.watch(print, 0) == 2


def test_a_node_may_have_another_version_of_a_package_that_the_run_does_not_use(new_fleet, local_name):
    ray = FakeRay(0, 1)
    ray.answers["n1"] = {"plugins": {"problems/other": ["toys", "1.1", "a" * 64]}}
    fleet = new_fleet(ray, 1)
    gather(fleet, [])
    assert fleet.watch(print, 0) == 1


def test_a_later_node_that_fails_the_check_gets_no_workers(new_fleet, local_name):
    ray, notes = FakeRay(0, 1), list[str]()
    fleet = new_fleet(ray, None)
    gather(fleet, notes)
    fleet.watch(notes.append, 0)
    ray.cores[2], ray.answers["n2"] = 4, {"code": "0" * 64}
    assert [fleet.watch(notes.append, 0) for _ in range(3)] == [1, 1, 1]
    assert len([n for n in notes if n.endswith("no worker is placed there")]) == 1


def test_the_run_waits_for_running_checks_and_then_starts_without_them(new_fleet, local_name, monkeypatch):
    ray, notes = FakeRay(0, 2, 2), list[str]()
    ray.slow.add(2)
    fleet = new_fleet(ray, 2)
    turns = iter(range(20))
    fleet.gather("tls/localtest:0", "", "", notes.append, lambda: next(turns, None) is None, NEEDED)
    assert next(turns, None) is None, "the run started"
    monkeypatch.setattr(fleet_module, "CHECKS_S", 0.01)
    gather(fleet, notes)
    assert list(fleet._placement.nodes) == ["n1"]
    ray.slow.clear()
    for _ in range(2):  # the first check fails, the second reaches the learner
        fleet.watch(notes.append, 0)
    assert list(fleet._placement.nodes) == ["n1", "n2"]


def test_a_node_that_could_not_reach_the_learner_is_checked_again(new_fleet, local_name):
    """The learner may be about to start; a lasting failure is reported once."""
    ray, notes = FakeRay(0, 1), list[str]()
    fleet = new_fleet(ray, None)
    gather(fleet, notes)
    fleet.watch(notes.append, 0)
    ray.cores[2], ray.answers["n2"] = 1, {"unreached": ["10.0.0.9:7447: refused"]}
    assert [fleet.watch(notes.append, 0) for _ in range(2)] == [1, 1] and "n2" not in "".join(notes)
    for _ in range(3):
        fleet.watch(notes.append, 0)
    (line,) = [note for note in notes if "n2" in note]
    assert "cannot reach the learner's port, 10.0.0.9:7447: refused" in line
    ray.answers.clear()
    assert fleet.watch(notes.append, 0) == 2


def test_a_node_that_is_lost_during_its_check_does_not_stop_the_run(new_fleet, local_name):
    ray, notes = FakeRay(0, 2, 2), list[str]()
    ray.answers["n2"] = RuntimeError("the worker died unexpectedly")
    ray.unreachable.add(2)
    fleet = new_fleet(ray, 2)
    gather(fleet, notes, turns=20)
    ray.cores[2] = None
    gather(fleet, notes)
    assert fleet.watch(notes.append, 0) == 2 and placements(ray) == ["n1", "n1"]


def test_a_node_on_which_ray_fails_repeatedly_is_refused(new_fleet, local_name):
    ray = FakeRay(0, 2, 2)
    ray.answers["n2"] = RuntimeError("the worker died unexpectedly")
    with pytest.raises(ConfigError, match=r"10.0.0.2: the worker died unexpectedly; run `ray up` again"):
        gather(new_fleet(ray, 4), [])


def test_a_later_node_cannot_join_a_run_with_a_loopback_endpoint(new_fleet):
    ray, notes = FakeRay(2), list[str]()
    fleet = new_fleet(ray, None)
    gather(fleet, notes, LOOPBACK)
    fleet.watch(notes.append, 0)
    ray.cores[1] = 4
    assert [fleet.watch(notes.append, 0) for _ in range(3)] == [2, 2, 2]
    (line,) = [note for note in notes if "other nodes cannot reach it" in note]
    assert line.startswith("10.0.0.1: stream.endpoint = 'tcp/127.0.0.1:0'") and line.endswith("no worker is placed there")


def test_a_loopback_endpoint_is_refused_on_a_cluster_of_several_nodes(new_fleet):
    ray = FakeRay(0, 1, 1)
    with pytest.raises(ConfigError, match=r"stream.endpoint = 'tcp/127.0.0.1:0': other nodes cannot reach it.*tls/HEAD_IP"):
        gather(new_fleet(ray, 2), [], LOOPBACK)
    assert not ray.placed
    one_node = FakeRay(2)
    fleet = new_fleet(one_node, 2)
    gather(fleet, [], LOOPBACK)
    assert fleet.watch(print, 0) == 2 and len(one_node.placed) == 2


def test_an_occupied_port_is_refused(new_fleet):
    with socket.create_server(("127.0.0.1", 0)) as server, pytest.raises(ConfigError, match="cannot be listened on"):
        gather(new_fleet(FakeRay(2), 2), [], f"tcp/127.0.0.1:{server.getsockname()[1]}")


def test_an_address_without_a_cluster_is_refused(new_fleet):
    with pytest.raises(ConfigError, match=r"--address 192.0.2.99:6379: no answer; `ray status`"):
        new_fleet(FakeRay(), 1, address="192.0.2.99:6379")
