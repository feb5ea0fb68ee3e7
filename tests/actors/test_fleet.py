"""Where and when a fleet launches its workers, against a Ray that only keeps account."""

import sys
from types import SimpleNamespace

import pytest

from actors import fleet
from icrl_dist.config import ConfigError

OURS, HEADS = "tcp/127.0.0.1:7447", "tls/192.0.2.10:7447"


class AccountingRay:
    """A cluster of machines, each with the cores that ``cores`` says."""

    exceptions = SimpleNamespace(AuthenticationError=PermissionError)

    def __init__(self, *cores):
        self.cores = list(cores)
        self.placed = []

    def init(self, address, **options):
        if address == "192.0.2.99:6379":
            raise ConnectionError("nobody there")

    def cluster_resources(self):
        return {"CPU": float(sum(self.cores))}

    def nodes(self):
        return [{"Alive": True} for _ in self.cores]

    def remote(self, **options):
        def place(host):
            self.placed.append(options)
            work = SimpleNamespace(remote=lambda endpoint, run_name, name, *_: name)
            return SimpleNamespace(remote=lambda: SimpleNamespace(work=work))

        return place

    def wait(self, running, **_):
        return [], running


@pytest.fixture
def join(monkeypatch):
    def joined(ray, actors, endpoint, address="auto"):
        monkeypatch.setitem(sys.modules, "ray", ray)
        monkeypatch.setattr(fleet, "_SETTINGS", {})  # this process goes on to other tests
        made = fleet.Fleet(actors, restarts=1, address=address)
        made.start(endpoint, "run")
        return made

    return joined


def test_workers_are_launched_when_the_cluster_has_a_core_for_each_and_spread(join):
    ray, notes = AccountingRay(0, 1), []
    made = join(ray, 2, HEADS)
    assert [made.watch(notes.append, 0) for _ in range(3)] == [2, 2, 2] and not ray.placed
    assert notes == ["the cluster at auto has 1 cores for 2 workers so far: waiting for more machines to join"]
    ray.cores.append(4)
    assert [made.watch(notes.append, 0) for _ in range(3)] == [2, 2, 2] and len(notes) == 1
    assert [(options["num_cpus"], options["scheduling_strategy"]) for options in ray.placed] == [(1, "SPREAD")] * 2


def test_a_cluster_that_stays_too_small_is_named(join, monkeypatch):
    monkeypatch.setattr(fleet, "JOIN_S", -1.0)
    ray = AccountingRay(0, 1)
    with pytest.raises(ConfigError, match=r"the cluster at auto has 1 cores for 2 workers .*--actors"):
        join(ray, 2, HEADS).watch(print, 0)
    assert not ray.placed


def test_other_machines_are_not_sent_to_a_learner_that_only_this_one_reaches(join):
    ray = AccountingRay(0, 1, 1)
    with pytest.raises(
        ConfigError, match=r"stream.endpoint = 'tcp/127.0.0.1:7447': other machines cannot reach it.*tls/HEAD_IP"
    ):
        join(ray, 2, OURS).watch(print, 0)
    assert not ray.placed
    alone = AccountingRay(2)
    assert join(alone, 2, OURS).watch(print, 0) == 2 and len(alone.placed) == 2


def test_a_cluster_that_does_not_answer_is_named(join):
    with pytest.raises(ConfigError, match=r"--address 192.0.2.99:6379: nobody there; `ray status`"):
        join(AccountingRay(), 1, HEADS, address="192.0.2.99:6379")
