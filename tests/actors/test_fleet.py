"""Where and when a fleet starts its workers, and which deaths it counts, on a fake Ray."""

import time
from types import SimpleNamespace

import pytest

from actors import cluster, running_time
from actors import fleet as fleet_module
from actors.fleet import FleetFailed
from tests.actors.fake_ray import LOOPBACK, FakeRay, FakeSession, gather, local_name, new_fleet, placements

__all__ = ["local_name", "new_fleet"]


def test_workers_start_when_each_has_a_core_and_are_spread(new_fleet, local_name):
    ray, notes = FakeRay(0, 1), list[str]()
    fleet = new_fleet(ray, 2)
    gather(fleet, notes, turns=5)
    assert notes == ["the cluster at auto has 1 cores for 2 workers so far: waiting for more nodes to join"]
    ray.cores[2] = 4
    gather(fleet, notes)
    assert [fleet.watch(notes.append, 0) for _ in range(3)] == [2, 2, 2]
    assert sorted(placements(ray)) == ["n1", "n2"] and {cpus for _, cpus in ray.placed} == {1}
    assert notes[-1] == "workers: n1 (10.0.0.1): w0; n2 (10.0.0.2): w1"


@pytest.mark.parametrize("restarts", [0, 1])
def test_without_a_cluster_a_spare_is_kept_from_the_first_progress_if_restarts_are_allowed(new_fleet, restarts):
    ray = FakeRay()
    fleet = new_fleet(ray, 1, address=None, restarts=restarts, oversubscribe=True)
    fleet.start(LOOPBACK, "run")
    for progress in (0, 1, 2):
        fleet.watch(print, progress)
    assert ray.placed == [("", 1)] + [("", 0)] * restarts


def test_without_a_number_of_workers_there_is_one_per_core_also_of_later_nodes(new_fleet, local_name):
    ray, notes = FakeRay(0, 2, 2), list[str]()
    fleet = new_fleet(ray, None, expected=(("10.0.0.1", "10.0.0.2"), 2))
    gather(fleet, notes)
    assert fleet.watch(notes.append, 0) == 4 and sorted(placements(ray)) == ["n1", "n1", "n2", "n2"]
    ray.cores[3] = 1
    fleet.watch(notes.append, 0)
    assert fleet.watch(notes.append, 0) == 5 and placements(ray)[-1] == "n3"


def test_workers_of_a_lost_node_move_and_no_death_is_counted(new_fleet, local_name):
    ray, notes = FakeRay(0, 1, 1), list[str]()
    fleet = new_fleet(ray, 2)
    gather(fleet, notes)
    fleet.watch(notes.append, 0)
    ray.cores[1] = None
    assert fleet.watch(notes.append, 0) == 2 and fleet.deaths == 0 and len(ray.placed) == 2
    assert "node n1 (10.0.0.1) has left; its 1 workers start on other nodes" in notes[-1]
    ray.cores[3] = 1
    fleet.watch(notes.append, 0)
    fleet.watch(notes.append, 0)
    assert placements(ray)[-1] == "n3" and notes[-1].endswith("n3 (10.0.0.3): w0-1")


def test_a_worker_that_dies_by_itself_is_counted_and_restarted_on_its_node(new_fleet, local_name):
    ray, notes = FakeRay(0, 1), list[str]()
    fleet = new_fleet(ray, 1)
    gather(fleet, notes)
    fleet.watch(notes.append, 0)
    for name in ("w0", "w0-1"):
        ray.errors["work", "n1", name] = RuntimeError("an error\nwith two lines")
        if name == "w0":
            assert fleet.watch(notes.append, 0) == 1 and notes[-1] == "worker w0 died (with two lines); starting it again"
    with pytest.raises(FleetFailed, match="w0 died 2 times without progress; last: with two lines"):
        fleet.watch(notes.append, 0)
    assert fleet.deaths == 2 and placements(ray) == ["n1", "n1"]


def test_a_death_at_the_same_time_as_a_node_loss_is_not_counted(new_fleet, local_name, monkeypatch):
    ray, notes = FakeRay(0, 1), list[str]()
    fleet = new_fleet(ray, 1)
    gather(fleet, notes)
    fleet.watch(notes.append, 0)
    monkeypatch.setattr(cluster, "REFRESH_S", 1e9)  # the fleet detects the death of the worker first
    ray.errors["work", "n1", "w0"] = RuntimeError("its node has died")
    ray.cores[1] = None
    assert fleet.watch(notes.append, 0) == 1 and fleet.deaths == 0 and "n1 (10.0.0.1) has left" in notes[-1]


GONE = ChildProcessError("The actor is temporarily unavailable")


def test_an_end_is_undecided_while_the_node_cannot_be_reached(new_fleet, local_name):
    """Ray lists a node as alive for some time after its end."""
    ray, notes = FakeRay(0, 1, 1), list[str]()
    fleet = new_fleet(ray, 2, restarts=0)
    gather(fleet, notes)
    fleet.watch(notes.append, 0)
    ray.unreachable.add(1)
    ray.errors["work", "n1", "w0"] = GONE
    for _ in range(3):
        assert fleet.watch(notes.append, 0) == 2 and len(ray.placed) == 2 and not fleet.lost
    ray.cores[1], ray.cores[3] = None, 1
    fleet.watch(notes.append, 0)
    fleet.watch(notes.append, 0)
    assert fleet.deaths == 0 and fleet.lost == ["w0"] and notes[-1].endswith("n3 (10.0.0.3): w0-1")


def test_a_death_on_a_reachable_node_is_counted_until_the_node_is_lost_soon_after(new_fleet, local_name):
    ray, notes = FakeRay(0, 1), list[str]()
    fleet = new_fleet(ray, 1, restarts=2)
    gather(fleet, notes)
    fleet.watch(notes.append, 0)
    ray.unreachable.add(1)
    ray.errors["work", "n1", "w0"] = GONE
    fleet.watch(notes.append, 0)
    ray.unreachable.clear()
    assert fleet.watch(notes.append, 0) == 1 and fleet.deaths == 1 and len(ray.placed) == 2
    ray.errors["work", "n1", "w0-1"] = GONE
    assert fleet.watch(notes.append, 0) == 1 and fleet.deaths == 2 and len(ray.placed) == 3, "restarted at once"
    ray.cores[1] = None
    fleet.watch(notes.append, 0)
    assert fleet.deaths == 0 and fleet.lost == ["w0-2", "w0", "w0-1"], "the loss of the node caused these deaths"


def test_every_life_of_a_worker_has_its_own_name_when_one_death_is_detected_first(new_fleet, local_name, monkeypatch):
    ray, notes = FakeRay(0, 2, 2), list[str]()
    fleet = new_fleet(ray, 2)
    gather(fleet, notes)
    ray.cores[2] = None
    fleet.watch(notes.append, 0)
    ray.cores[3] = 2  # room for both
    fleet.watch(notes.append, 0)
    assert placements(ray) == ["n1", "n1"]
    monkeypatch.setattr(cluster, "REFRESH_S", 1e9)
    ray.errors["work", "n1", "w1"] = GONE
    ray.cores[1] = None
    fleet.watch(notes.append, 0)
    assert notes[-1] == "workers: n3 (10.0.0.3): w0-1 w1-1" and sorted(fleet.lost) == ["w0", "w1"]


def test_missing_nodes_are_reported_and_the_run_starts_with_at_least_the_minimum(new_fleet, local_name, monkeypatch):
    monkeypatch.setattr(fleet_module, "REPORT_MISSING_S", 0.01)
    ray, notes = FakeRay(0, 2), list[str]()
    fleet = new_fleet(ray, 6, at_least=2, expected=(("10.0.0.1", "10.0.0.7"), 2))
    gather(fleet, notes)
    assert [n for n in notes if n.startswith("10.0.0.7 has not joined")] and "starting with 2 workers" in notes[-1]
    assert fleet.watch(notes.append, 0) == 6 and len(ray.placed) == 2  # four wait for a node


def test_after_the_end_of_a_process_of_ray_all_workers_start_in_a_new_session_and_no_death_is_counted(new_fleet):
    ray, notes = FakeRay(), list[str]()
    fleet = new_fleet(ray, 2, address=None, restarts=1, oversubscribe=True)
    fleet.start(LOOPBACK, "run")
    assert fleet.watch(notes.append, 0) == 2
    FakeSession.made.cause = "Ray's process raylet (7) has ended"
    assert fleet.watch(notes.append, 0) == 2 and FakeSession.made.restarts == 1
    assert "Ray's process raylet (7) has ended; `dmesg` shows" in notes[-1] and notes[-1].endswith(
        "starting Ray and its workers again"
    )
    assert len(ray.placed) == 4 and fleet.lost == ["w0", "w1"] and fleet.deaths == 0
    assert fleet._name(0) == "w0-1", "every life of a worker has its own name"
    FakeSession.made.cause = "Ray's process gcs_server (8) has ended"
    with pytest.raises(FleetFailed, match=r"gcs_server \(8\) has ended; `dmesg`"):
        fleet.watch(notes.append, 0)
    assert fleet.watch(notes.append, 1) == 2 and FakeSession.made.restarts == 2, "after progress it may be restarted again"
    fleet.close()
    assert FakeSession.made.closed


def test_ray_is_not_started_again_for_workers_that_the_learner_has_stopped(new_fleet, monkeypatch):
    ray = FakeRay()
    fleet = new_fleet(ray, 1, address=None, restarts=1, oversubscribe=True)
    fleet.start(LOOPBACK, "run")
    fleet.watch(print, 0)
    monkeypatch.setattr(ray, "wait", lambda running, **_: (running, []))
    monkeypatch.setattr(ray, "get", lambda work: None)
    assert fleet.watch(print, 0) == 0
    FakeSession.made.cause = "Ray's process raylet (7) has ended"
    assert fleet.watch(print, 0) == 0 and FakeSession.made.restarts == 0


def test_a_cluster_whose_head_does_not_answer_is_lost_before_ray_aborts_the_process(new_fleet, local_name, monkeypatch):
    ray, notes = FakeRay(0, 1), list[str]()
    fleet = new_fleet(ray, 1)
    gather(fleet, notes)
    fleet.watch(notes.append, 0)
    began = now = time.monotonic()
    monkeypatch.setattr(running_time, "time", SimpleNamespace(monotonic=lambda: now))
    ray.unreachable.add(250)
    monkeypatch.setattr(ray, "nodes", lambda: pytest.fail("a call to Ray would not return"))
    for step in (2.0, 4.0, 3600.0, 3602.0):  # a stop of an hour does not count
        now = began + step
        assert fleet.watch(notes.append, 0) == 1
    with pytest.raises(FleetFailed, match=r"head has not answered for 30 s \(timed out\): start the cluster again"):
        for step in range(3604, 3640, 2):
            now = began + step
            fleet.watch(notes.append, 0)
