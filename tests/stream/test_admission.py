"""A process that listens keeps its descriptors and its sessions, whatever connects to its port."""

import contextlib
import json
import resource
import socket
import subprocess
import sys
import time

import pytest

from icrl_dist.stream import admission, endpoints, security
from icrl_dist.stream.link import LinkError, Unanswered
from icrl_dist.stream.zenoh_link import ZenohLink
from tests import certificates
from tests.contracts.link_battery import eventually

pytestmark = pytest.mark.integration

LISTENS = """
import json, os, resource, sys
folder, limit, changes = sys.argv[1], int(sys.argv[2]), json.loads(sys.argv[3])
resource.setrlimit(resource.RLIMIT_NOFILE, (min(limit, 200), limit))
from icrl_dist.stream import admission, security
from icrl_dist.stream.zenoh_link import ZenohLink
vars(admission).update(changes)
def peak():
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss >> 10
with ZenohLink.listen("tls/127.0.0.1:0", security.learner(folder, "run"), 4 << 20) as link:
    def answer(query):
        files = [open(os.devnull) for _ in range(30)]  # as a learner opens segments and checkpoints
        query.reply(json.dumps([len(os.listdir("/proc/self/fd")), link._admission.closed, peak()]).encode())
    link.serve("icrl/run/work", answer)
    print(link.endpoints[0], flush=True)
    sys.stdin.read()
"""


@pytest.fixture(scope="module")
def certified(tmp_path_factory):
    return certificates.make(tmp_path_factory.mktemp("certified"))


@pytest.fixture
def listening(certified):
    """``listening(limit, **changes)``: the endpoint of a learner's link in a process with this limit on descriptors."""
    with contextlib.ExitStack() as stack:

        def start(limit, **changes):
            command = [sys.executable, "-c", LISTENS, certified, str(limit), json.dumps(changes)]
            process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
            stack.callback(process.communicate)
            stack.callback(process.kill)
            assert process.stdout is not None
            return process.stdout.readline().strip()

        yield start


def connect(endpoint, certified, role="worker", timeout_s=30.0):
    return ZenohLink.connect(endpoint, timeout_s, security.client(certified, role))


def state(link):
    """Open descriptors of the other process while it opens 30 files, whether its port is closed, and its peak memory, MB."""
    return json.loads(link.request("icrl/run/work", b"", timeout_s=10.0))


def test_bare_connections_leave_descriptors_and_the_port_opens_again(listening, certified):
    endpoint = listening(512, MAX_PENDING=16)
    place = ("127.0.0.1", endpoints.parse(endpoint).port)
    with contextlib.ExitStack() as stack:
        worker = stack.enter_context(connect(endpoint, certified))
        eventually(lambda: state(worker) and True)
        flood = stack.enter_context(contextlib.ExitStack())
        made = 0
        with contextlib.suppress(TimeoutError):
            for made in range(600):  # noqa: B007
                flood.enter_context(socket.create_connection(place, timeout=0.5))
                time.sleep(0.001)
        assert 16 <= made < 599, "the port is closed"
        used, closed, _ = state(worker)
        assert closed and used < 450, "before the descriptors are used up"
        flood.close()
        eventually(lambda: not state(worker)[1])
        with connect(endpoint, certified) as another:
            assert state(another)[0] < 100


def test_monitors_cannot_use_up_the_sessions(listening, certified):
    endpoint = listening(300, MAX_MONITORS=3)
    with contextlib.ExitStack() as stack:
        worker = stack.enter_context(connect(endpoint, certified))
        used = state(worker)[0]
        for _ in range(10):
            with contextlib.suppress(LinkError):
                stack.enter_context(connect(endpoint, certified, "monitor", 2.0))
        eventually(lambda: state(worker)[0] <= used + 3)
        with connect(endpoint, certified) as another:
            assert state(another)


def test_sessions_have_a_limit_below_that_of_the_descriptors(listening, certified):
    endpoint = listening(128)
    with contextlib.ExitStack() as stack:
        links = list[ZenohLink]()
        with contextlib.suppress(LinkError):
            while len(links) < 128:
                links.append(stack.enter_context(connect(endpoint, certified, timeout_s=1.0)))
        assert 24 <= len(links) <= 48
        assert state(links[0])[0] <= 128, "the 30 files were opened"


def test_a_message_beyond_the_limit_is_dropped_before_it_is_complete(listening, certified):
    endpoint = listening(300)
    with connect(endpoint, certified) as worker:
        eventually(lambda: state(worker) and True)
        assert worker.request("icrl/run/work", bytes(3 << 20), timeout_s=10.0)
        before = state(worker)[2]
        with pytest.raises(Unanswered):
            worker.request("icrl/run/work", bytes(200 << 20), timeout_s=2.0)
        assert state(worker)[2] < before + 40, "MB"


def test_the_limit_on_descriptors_is_raised_and_has_a_reserve():
    before = resource.getrlimit(resource.RLIMIT_NOFILE)
    try:
        descriptors = admission.Descriptors()
        soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
        assert hard == before[1] and descriptors.usable < soft < hard
        assert descriptors.sessions < descriptors.usable
        descriptors.release_reserve()
        assert resource.getrlimit(resource.RLIMIT_NOFILE)[0] > soft
    finally:
        resource.setrlimit(resource.RLIMIT_NOFILE, before)


def test_a_link_that_is_closed_frees_its_port(certified):
    with ZenohLink.listen("tcp/127.0.0.1:0") as link:
        place = ("127.0.0.1", endpoints.parse(link.endpoints[0]).port)
        socket.create_connection(place).close()
    with pytest.raises(ConnectionRefusedError):
        socket.create_connection(place)
    with ZenohLink.listen(link.endpoints[0]):
        socket.create_connection(place).close()
    with pytest.raises((LinkError, Unanswered)):
        link.request("x", b"", 1.0)
