"""Where and when a fleet launches its workers, against a Ray that only keeps account."""

import socket
import sys
from types import SimpleNamespace

import pytest

from actors import cluster, fleet, missing
from icrl_dist.config.run import ConfigError
from icrl_dist.diagnostics import node_facts

REACH = node_facts.reach
OURS, HEADS = "tcp/127.0.0.1:0", "tls/localtest:7447"


class AccountingRay:
    """A cluster of machines, each with the cores that ``cores`` says; ``answers`` change what a machine says of itself."""

    exceptions = SimpleNamespace(
        AuthenticationError=PermissionError, RayActorError=ChildProcessError, RayTaskError=ModuleNotFoundError
    )
    util = SimpleNamespace(
        scheduling_strategies=SimpleNamespace(NodeAffinitySchedulingStrategy=lambda node, soft: (node, soft))
    )

    def __init__(self, *cores):
        self.cores = dict(enumerate(cores))
        self.placed, self.ended, self.killed = [], {}, []
        self.answers = {}
        self.silent, self.slow = set(), set()
        """Numbers of machines whose Ray is not reached, and of those that have yet to answer what they were asked."""

    def init(self, address=None, **options):
        if address == "192.0.2.99:6379":
            raise ConnectionError("nobody there")

    def nodes(self):
        where = {"NodeManagerPort": 1}
        return [
            {"NodeID": f"n{i}", "Alive": cores is not None, "NodeManagerAddress": f"10.0.0.{i}", "Resources": {"CPU": cores}}
            | where
            for i, cores in self.cores.items()
        ]

    def reach(self, host, port, timeout_s=3.0):
        if not host.startswith("10.0.0."):
            return REACH(host, port, timeout_s)
        return "timed out" if int(host.split(".")[-1]) in self.silent else ""

    def remote(self, num_cpus, scheduling_strategy, **options):
        node, soft = ("", False) if scheduling_strategy == "SPREAD" else scheduling_strategy
        assert soft is False

        def made(what):
            if what is node_facts.facts:
                return SimpleNamespace(remote=lambda certificates, ports: ("facts", node, tuple(ports)))
            self.placed.append((node, num_cpus))
            work = SimpleNamespace(remote=lambda endpoint, run_name, name, *_: ("work", node, name))
            return SimpleNamespace(remote=lambda: SimpleNamespace(work=work))

        return made

    def wait(self, under_way, **_):
        answered = lambda node: node not in {f"n{i}" for i in self.slow}  # noqa: E731
        return [one for one in under_way if one in self.ended or (one[0] == "facts" and answered(one[1]))], []

    def get(self, one):
        if one[0] == "work":
            raise self.ended.pop(one)
        said = {**HERE, "host": one[1], "unreached": [node_facts.reach(*p) for p in one[2] if p[1] and node_facts.reach(*p)]}
        changed = self.answers.get(one[1], {})
        if isinstance(changed, Exception):
            raise changed
        return {**said, **changed}

    def kill(self, host):
        self.killed.append(host)

    def shutdown(self):
        pass


HERE = node_facts.facts()


@pytest.fixture
def join(monkeypatch):
    monkeypatch.setattr(fleet, "_SETTINGS", {})  # this process goes on to other tests
    monkeypatch.setattr(fleet, "_PAUSE_S", 0.001)
    monkeypatch.setattr(cluster, "LOOK_S", 0.0)
    monkeypatch.setattr(cluster, "AGAIN_S", 0.0)
    monkeypatch.setattr(cluster, "SILENT_S", 0.0)
    monkeypatch.setattr(fleet, "DOUBT_S", 0.0)
    promised = missing.Expected()
    monkeypatch.setattr(cluster.missing, "expected", lambda: promised)
    for name, value in (("NOTE_S", -1.0), ("SHORT_S", 1e9), ("JOIN_S", 1e9)):
        monkeypatch.setattr(fleet, name, value)

    def joined(ray, actors, address="auto", restarts=1, **options):
        nonlocal promised
        promised = missing.Expected(*options.pop("promised", ((), 0)))
        monkeypatch.setitem(sys.modules, "ray", ray)
        monkeypatch.setattr(cluster.node_facts, "reach", ray.reach)
        return fleet.Fleet(actors, restarts, address, **options)

    return joined


@pytest.fixture
def local_name(monkeypatch):
    """A name of this machine that is not its loopback's."""
    real = socket.getaddrinfo
    monkeypatch.setattr(
        socket, "getaddrinfo", lambda host, *a, **k: real("127.0.0.1" if host == "localtest" else host, *a, **k)
    )
    monkeypatch.setattr(node_facts.socket, "create_server", _server(node_facts.socket.create_server))


def _server(real):
    return lambda address, **options: real(("127.0.0.1" if address[0] == "localtest" else address[0], 0), **options)


def gather(made, notes, endpoint="tls/localtest:0", turns=None):
    left = [turns]

    def stopped():
        if left[0] is not None:
            left[0] -= 1
            return left[0] < 0
        return False

    made.gather(endpoint, "", "", notes.append, stopped)
    made.start(endpoint, "run")


def names(ray):
    return [node for node, _ in ray.placed]


def test_workers_are_launched_when_there_is_a_core_for_each_and_spread(join, local_name):
    ray, notes = AccountingRay(0, 1), []
    made = join(ray, 2)
    gather(made, notes, turns=5)
    assert notes == ["the cluster at auto has 1 cores for 2 workers so far: waiting for more machines to join"]
    ray.cores[2] = 4
    gather(made, notes)
    assert [made.watch(notes.append, 0) for _ in range(3)] == [2, 2, 2]
    assert sorted(names(ray)) == ["n1", "n2"] and {cpus for _, cpus in ray.placed} == {1}
    assert notes[-1] == "workers: n1 (10.0.0.1): w0; n2 (10.0.0.2): w1"


@pytest.mark.parametrize("restarts", [0, 1])
def test_on_one_machine_a_spare_is_kept_from_the_first_progress_on_if_it_could_be_needed(join, restarts):
    ray = AccountingRay()
    made = join(ray, 1, address=None, restarts=restarts, oversubscribe=True)
    made.start(OURS, "run")
    for progress in (0, 1, 2):
        made.watch(print, progress)
    assert ray.placed == [("", 1)] + [("", 0)] * restarts


def test_without_a_number_a_fleet_is_as_large_as_the_cluster_and_grows_with_it(join, local_name):
    ray, notes = AccountingRay(0, 2, 2), []
    made = join(ray, None, promised=(("10.0.0.1", "10.0.0.2"), 2))
    gather(made, notes)
    assert made.watch(notes.append, 0) == 4 and sorted(names(ray)) == ["n1", "n1", "n2", "n2"]
    ray.cores[3] = 1
    made.watch(notes.append, 0)
    assert made.watch(notes.append, 0) == 5 and names(ray)[-1] == "n3"


def test_workers_of_a_machine_that_left_go_elsewhere_and_cost_nobody_a_life(join, local_name):
    ray, notes = AccountingRay(0, 1, 1), []
    made = join(ray, 2)
    gather(made, notes)
    made.watch(notes.append, 0)
    ray.cores[1] = None
    assert made.watch(notes.append, 0) == 2 and made.deaths == 0 and len(ray.placed) == 2
    assert "machine n1 (10.0.0.1) is gone; its 1 workers go where there is room" in notes[-1]
    ray.cores[3] = 1
    made.watch(notes.append, 0)
    made.watch(notes.append, 0)
    assert names(ray)[-1] == "n3" and notes[-1].endswith("n3 (10.0.0.3): w0-1")


def test_a_worker_that_dies_by_itself_counts_and_stays_where_it_was(join, local_name):
    ray, notes = AccountingRay(0, 1), []
    made = join(ray, 1)
    gather(made, notes)
    made.watch(notes.append, 0)
    for life in ("w0", "w0-1"):
        ray.ended["work", "n1", life] = RuntimeError("the last\nof its words")
        if life == "w0":
            assert made.watch(notes.append, 0) == 1 and notes[-1] == "worker w0 died (of its words); starting it again"
    with pytest.raises(fleet.FleetFailed, match="w0 died 2 times without progress; last: of its words"):
        made.watch(notes.append, 0)
    assert made.deaths == 2 and names(ray) == ["n1", "n1"]


def test_death_and_departure_at_once_are_a_departure(join, local_name, monkeypatch):
    ray, notes = AccountingRay(0, 1), []
    made = join(ray, 1)
    gather(made, notes)
    made.watch(notes.append, 0)
    monkeypatch.setattr(cluster, "LOOK_S", 1e9)  # the fleet hears of its worker first
    ray.ended["work", "n1", "w0"] = RuntimeError("its node has died")
    ray.cores[1] = None
    assert made.watch(notes.append, 0) == 1 and made.deaths == 0 and "n1 (10.0.0.1) is gone" in notes[-1]


GONE = ChildProcessError("The actor is temporarily unavailable")


def test_nothing_is_decided_while_a_machine_does_not_answer(join, local_name):
    """Ray calls a machine alive for a while after its end."""
    ray, notes = AccountingRay(0, 1, 1), []
    made = join(ray, 2, restarts=0)
    gather(made, notes)
    made.watch(notes.append, 0)
    ray.silent.add(1)
    ray.ended["work", "n1", "w0"] = GONE
    for _ in range(3):
        assert made.watch(notes.append, 0) == 2 and len(ray.placed) == 2 and not made.lost
    ray.cores[1], ray.cores[3] = None, 1
    made.watch(notes.append, 0)
    made.watch(notes.append, 0)
    assert made.deaths == 0 and made.lost == ["w0"] and notes[-1].endswith("n3 (10.0.0.3): w0-1")


def test_a_worker_whose_machine_answers_again_or_still_died_by_itself(join, local_name):
    ray, notes = AccountingRay(0, 1), []
    made = join(ray, 1, restarts=2)
    gather(made, notes)
    made.watch(notes.append, 0)
    ray.silent.add(1)
    ray.ended["work", "n1", "w0"] = GONE
    made.watch(notes.append, 0)
    ray.silent.clear()
    assert made.watch(notes.append, 0) == 1 and made.deaths == 1 and len(ray.placed) == 2
    ray.ended["work", "n1", "w0-1"] = GONE
    assert made.watch(notes.append, 0) == 1 and made.deaths == 2 and len(ray.placed) == 3, "at once"
    ray.cores[1] = None
    made.watch(notes.append, 0)
    assert made.deaths == 0 and made.lost == ["w0-2", "w0", "w0-1"], "they were the beginning of its machine's end"


def test_a_name_is_one_life_although_one_of_a_machine_that_died_is_heard_of_first(join, local_name, monkeypatch):
    ray, notes = AccountingRay(0, 2, 2), []
    made = join(ray, 2)
    gather(made, notes)
    ray.cores[2] = None
    made.watch(notes.append, 0)
    ray.cores[3] = 2  # there is room for both at once
    made.watch(notes.append, 0)
    assert names(ray) == ["n1", "n1"]
    monkeypatch.setattr(cluster, "LOOK_S", 1e9)
    ray.ended["work", "n1", "w1"] = GONE
    ray.cores[1] = None
    made.watch(notes.append, 0)
    assert notes[-1] == "workers: n3 (10.0.0.3): w0-1 w1-1" and sorted(made.lost) == ["w0", "w1"]


def test_missing_machines_are_named_and_it_begins_with_what_there_is_if_that_is_enough(join, local_name, monkeypatch):
    monkeypatch.setattr(fleet, "SHORT_S", 0.01)
    ray, notes = AccountingRay(0, 2), []
    made = join(ray, 6, at_least=2, promised=(("10.0.0.1", "10.0.0.7"), 2))
    gather(made, notes)
    assert [n for n in notes if n.startswith("10.0.0.7 has not joined")] and "beginning with 2 workers" in notes[-1]
    assert made.watch(notes.append, 0) == 6 and len(ray.placed) == 2  # four wait for a place


def test_a_cluster_that_stays_too_small_is_named(join, local_name, monkeypatch):
    monkeypatch.setattr(fleet, "SHORT_S", -1.0)
    monkeypatch.setattr(fleet, "JOIN_S", 0.01)
    ray, notes = AccountingRay(0, 1), []
    with pytest.raises(ConfigError, match=r"the cluster at auto has 1 cores for 2 workers .*--actors"):
        gather(join(ray, 2, promised=(("10.0.0.1", "10.0.0.9"), 2)), notes)
    assert not ray.placed and [n for n in notes if n.startswith("10.0.0.9 has not joined")]


@pytest.mark.parametrize(
    ("answer", "message"),
    [
        ({"version": "0.0.9"}, r"n1 \(10.0.0.1\): icrl-dist 0.0.9 there, .* here: run `ray up` again"),
        ({"code": "f" * 64}, r"icrl-dist's code ffffffff there"),
        ({"versions": {**HERE["versions"], "torch": "1.0"}}, r"torch 1.0 there, .* here"),
        ({"python": "3.9.1"}, r"Python 3.9.1 there"),
        ({"certificates": "/c/worker.key: cannot be read"}, r"n1 \(10.0.0.1\): /c/worker.key"),
        ({"unreached": ["10.0.0.9:7447: timed out"]}, r"cannot reach the learner's port, 10.0.0.9:7447: timed out"),
        (
            {"certificates": "no key", "unreached": ["10.0.0.9:7447: refused"]},
            r"no key; cannot reach .* 10.0.0.9:7447: refused",
        ),
        (ModuleNotFoundError("No module named 'icrl_dist'"), r"10.0.0.1: No module named 'icrl_dist'; run `ray up` again"),
    ],
)
def test_a_machine_that_does_not_fit_is_refused_before_anything_starts(join, local_name, answer, message):
    ray = AccountingRay(0, 2, 2)
    ray.answers["n1"] = answer
    with pytest.raises(ConfigError, match=message) as error:
        gather(join(ray, 2), [])
    assert not ray.placed and "\n" not in str(error.value)


def test_one_that_joins_later_and_does_not_fit_is_left_out(join, local_name):
    ray, notes = AccountingRay(0, 1), []
    made = join(ray, None)
    gather(made, notes)
    made.watch(notes.append, 0)
    ray.cores[2], ray.answers["n2"] = 4, {"code": "0" * 64}
    assert [made.watch(notes.append, 0) for _ in range(3)] == [1, 1, 1]
    assert len([n for n in notes if n.endswith("no worker is placed there")]) == 1


def test_nobody_begins_while_a_machine_is_still_trying_to_reach_the_learner(join, local_name, monkeypatch):
    ray, notes = AccountingRay(0, 2, 2), []
    ray.slow.add(2)
    made = join(ray, 2)
    turns = iter(range(20))
    made.gather("tls/localtest:0", "", "", notes.append, lambda: next(turns, None) is None)
    assert next(turns, None) is None, "it began"
    monkeypatch.setattr(fleet, "PROBES_S", 0.01)
    gather(made, notes)
    assert list(made._placement.machines) == ["n1"]
    ray.slow.clear()
    for _ in range(2):  # it found nobody, and then the learner
        made.watch(notes.append, 0)
    assert list(made._placement.machines) == ["n1", "n2"]


def test_a_machine_that_found_nobody_at_the_port_is_asked_again(join, local_name):
    """The learner may be just starting; if it goes on, that is said once."""
    ray, notes = AccountingRay(0, 1), []
    made = join(ray, None)
    gather(made, notes)
    made.watch(notes.append, 0)
    ray.cores[2], ray.answers["n2"] = 1, {"unreached": ["10.0.0.9:7447: refused"]}
    assert [made.watch(notes.append, 0) for _ in range(2)] == [1, 1] and "n2" not in "".join(notes)
    for _ in range(3):
        made.watch(notes.append, 0)
    (line,) = [note for note in notes if "n2" in note]
    assert "cannot reach the learner's port, 10.0.0.9:7447: refused" in line
    ray.answers.clear()
    assert made.watch(notes.append, 0) == 2


def test_a_machine_that_ends_while_it_is_asked_does_not_stop_a_run(join, local_name):
    ray, notes = AccountingRay(0, 2, 2), []
    ray.answers["n2"] = RuntimeError("the worker died unexpectedly")
    ray.silent.add(2)
    made = join(ray, 2)
    gather(made, notes, turns=20)
    ray.cores[2] = None
    gather(made, notes)
    assert made.watch(notes.append, 0) == 2 and names(ray) == ["n1", "n1"]


def test_a_machine_on_which_ray_keeps_failing_is_refused(join, local_name):
    ray = AccountingRay(0, 2, 2)
    ray.answers["n2"] = RuntimeError("the worker died unexpectedly")
    with pytest.raises(ConfigError, match=r"10.0.0.2: the worker died unexpectedly; run `ray up` again"):
        gather(join(ray, 4), [])


def test_one_that_joins_a_run_that_only_its_own_machine_reaches_is_left_out(join):
    ray, notes = AccountingRay(2), []
    made = join(ray, None)
    gather(made, notes, OURS)
    made.watch(notes.append, 0)
    ray.cores[1] = 4
    assert [made.watch(notes.append, 0) for _ in range(3)] == [2, 2, 2]
    (line,) = [note for note in notes if "other machines cannot reach it" in note]
    assert line.startswith("10.0.0.1: stream.endpoint = 'tcp/127.0.0.1:0'") and line.endswith("no worker is placed there")


def test_other_machines_are_not_sent_to_a_learner_that_only_this_one_reaches(join):
    ray = AccountingRay(0, 1, 1)
    with pytest.raises(ConfigError, match=r"stream.endpoint = 'tcp/127.0.0.1:0': other machines cannot reach it.*tls/HEAD_IP"):
        gather(join(ray, 2), [], OURS)
    assert not ray.placed
    alone = AccountingRay(2)
    made = join(alone, 2)
    gather(made, [], OURS)
    assert made.watch(print, 0) == 2 and len(alone.placed) == 2


def test_a_port_that_is_taken_is_named(join):
    with socket.create_server(("127.0.0.1", 0)) as server, pytest.raises(ConfigError, match="cannot be listened on"):
        gather(join(AccountingRay(2), 2), [], f"tcp/127.0.0.1:{server.getsockname()[1]}")


def test_a_cluster_that_does_not_answer_is_named(join):
    with pytest.raises(ConfigError, match=r"--address 192.0.2.99:6379: nobody there; `ray status`"):
        join(AccountingRay(), 1, address="192.0.2.99:6379")
