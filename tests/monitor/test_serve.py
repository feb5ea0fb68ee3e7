"""The HTTP server of the live view: events for many viewers, commands from its own page only."""

import asyncio
import http.client
import json
import socket
import threading
import time
from urllib.parse import urlsplit

import pytest

from icrl_dist.config.run import ConfigError
from icrl_dist.monitor import event_stream, serve
from icrl_dist.monitor.event_stream import EventStream
from icrl_dist.monitor.serve import application, serving


class PageClient:
    """Sends requests to a page; `commands` are those that the page has executed."""

    def __init__(self, url, stream, commands):
        self.stream, self.commands = stream, commands
        self.host, self.port = urlsplit(url).hostname, urlsplit(url).port

    def request(self, method, path, body=None, **headers):
        connection = http.client.HTTPConnection(self.host, self.port, timeout=5)
        try:
            connection.request(method, path, body, {name.replace("_", "-"): value for name, value in headers.items()})
            response = connection.getresponse()
            return response.status, dict(response.getheaders()), response.read()
        finally:
            connection.close()

    def command(self, body, **headers):
        headers = {"content_type": "application/json", **headers}
        status, _, text = self.request("POST", "/command", body, **headers)
        return status, text.decode()

    def connect(self):
        connection = http.client.HTTPConnection(self.host, self.port, timeout=5)
        connection.request("GET", "/events")
        return ViewerClient(connection, connection.getresponse())


class ViewerClient:
    def __init__(self, connection, response):
        self.connection, self.response = connection, response

    def next(self):
        """Name and data of the next event; None at the end of the stream."""
        event = None
        while line := self.response.readline():
            field, _, value = line.decode().strip().partition(": ")
            if field == "event":
                event = value
            elif field == "data":
                return event, json.loads(value)
        return None


@pytest.fixture
def page():
    stream, commands = EventStream(), []

    def command(fields):
        if "bad" in fields:
            raise ValueError(f"bad={fields['bad']}: refused")
        commands.append(fields)

    with serving(application("play.html", stream, command), stream, "127.0.0.1", 0) as url:
        yield PageClient(url, stream, commands)


def wait_for(condition):
    deadline = time.monotonic() + 5
    while not condition():
        assert time.monotonic() < deadline
        time.sleep(0.005)


def test_viewers_receive_the_state_first_and_then_new_events(page):
    page.stream.publish("room", {"step": 1}, state=True)
    page.stream.publish("note", {"to": "nobody"})
    viewers = [page.connect() for _ in range(3)]
    wait_for(lambda: page.stream.viewers == 3)
    page.stream.publish("note", {"to": "all"})
    for viewer in viewers:
        assert viewer.next() == ("room", {"step": 1})
        assert viewer.next() == ("note", {"to": "all"})
        viewer.connection.close()
        viewer.response.close()
    wait_for(lambda: page.stream.publish("note", 0) is None and page.stream.viewers == 0)


def test_a_slow_viewer_loses_the_oldest_events_but_no_state():
    async def receive_late():
        viewer = event_stream._Viewer(asyncio.get_running_loop())
        for number in range(event_stream.MAX_QUEUED + 50):
            viewer.put("note", event_stream._encoded("note", str(number)), False)
            viewer.put("room", event_stream._encoded("room", str(number)), True)
        return await viewer.next()

    lines = [line for line in asyncio.run(receive_late()).decode().splitlines() if line.startswith("data")]
    kept = range(51, event_stream.MAX_QUEUED + 50)
    assert lines == [*(f"data: {number}" for number in kept), f"data: {event_stream.MAX_QUEUED + 49}"]


def test_a_viewer_that_does_not_read_delays_nobody_and_is_removed_when_it_disconnects():
    stream, payload = EventStream(), "x" * 100_000
    with serving(application("play.html", stream), stream, "127.0.0.1", 0) as url:
        stuck, reader = (PageClient(url, stream, []).connect() for _ in range(2))
        wait_for(lambda: stream.viewers == 2)
        began = time.monotonic()
        for _ in range(2 * event_stream.MAX_QUEUED):
            stream.publish("note", payload)
        assert time.monotonic() - began < 5
        assert max(len(viewer._queue) for viewer in stream._viewers) <= event_stream.MAX_QUEUED
        stream.publish("last", 1)
        while (event := reader.next())[0] != "last":
            assert event == ("note", payload)
        stuck.connection.close()
        stuck.response.close()
        wait_for(lambda: stream.viewers == 1)
    assert reader.next() is None
    reader.connection.close()
    reader.response.close()


def test_a_quiet_stream_carries_pings(monkeypatch):
    monkeypatch.setattr(event_stream, "_PING_S", 0.05)
    stream = EventStream()
    with serving(application("play.html", stream), stream, "127.0.0.1", 0) as url:
        viewer = PageClient(url, stream, []).connect()
        lines = [viewer.response.readline() for _ in range(6)]
    assert lines == [b"retry: 1000\n", b"\n", *([b": ping\n", b"\n"] * 2)]
    viewer.connection.close()
    viewer.response.close()


def test_viewers_beyond_the_limit_are_refused(page, monkeypatch):
    monkeypatch.setattr(event_stream, "MAX_VIEWERS", 1)
    first = page.connect()
    wait_for(lambda: page.stream.viewers == 1)
    assert page.request("GET", "/events")[0] == 503
    first.connection.close()
    first.response.close()


def test_viewers_that_come_at_the_same_time_are_limited_too(monkeypatch):
    monkeypatch.setattr(event_stream, "MAX_VIEWERS", 2)
    stream = EventStream()

    async def come():
        streams = [stream._events() for _ in range(5)]
        first = [await anext(one, None) for one in streams]
        return sum(chunk is not None for chunk in first), stream.viewers

    assert asyncio.run(come()) == (2, 2)


def test_the_end_of_the_server_ends_every_stream_and_thread():
    before = threading.active_count()
    stream = EventStream()
    with serving(application("play.html", stream), stream, "127.0.0.1", 0) as url:
        viewer = PageClient(url, stream, []).connect()
        wait_for(lambda: stream.viewers == 1)
    assert viewer.next() is None
    viewer.connection.close()
    viewer.response.close()
    assert threading.active_count() == before


def test_every_response_forbids_foreign_scripts(page):
    for path, status in (
        ("/assets/base.css", 200),
        ("/nowhere", 404),
        ("/assets/serve.py", 404),
        ("/assets/..%2fserve.py", 404),
    ):
        found, headers, _ = page.request("GET", path)
        assert found == status
        policy = headers["content-security-policy"]
        assert policy.startswith("default-src 'none'; script-src 'self'; style-src 'self'") and "unsafe" not in policy
        assert headers["x-content-type-options"] == "nosniff"


def test_a_command_must_be_one_small_json_object(page):
    assert page.command('{"p": 0.5}') == (204, "")
    assert page.commands == [{"p": 0.5}]
    assert page.command('{"bad": 3}') == (400, '{"error":"bad=3: refused"}')
    for body in ("", "[]", "nonsense", '{"p": NaN}', '{"p": Infinity}', b'{"p": "\xff"}', "[" * 4000):
        status, text = page.command(body)
        assert status == 400 and len(json.loads(text)["error"].splitlines()) == 1, body
    assert page.command("x" * (serve.MAX_BODY + 1))[0] == 413
    assert page.command('{"p": 1}', content_type="text/plain")[0] == 415
    assert page.request("GET", "/command")[0] == 405
    assert page.commands == [{"p": 0.5}]


@pytest.mark.parametrize(
    "headers",
    [
        {"origin": "http://evil.example"},
        {"origin": "null"},
        {"origin": "http://127.0.0.1:1"},
        {"sec_fetch_site": "cross-site"},
        {"sec_fetch_site": "same-site"},
        {"host": "evil.example"},
        {"host": "127.0.0.1.evil.example"},
        {"host": "", "origin": "http://"},
    ],
)
def test_commands_of_a_foreign_page_are_refused(page, headers):
    status, text = page.command('{"p": 1}', **headers)
    assert status == 403 and len(text.splitlines()) == 1
    assert not page.commands


def test_a_foreign_host_name_is_refused(page):
    for host in ("evil.example", f"evil.example:{page.port}", "[evil]"):
        assert page.request("GET", "/events", host=host)[0] == 403
    for host in ("localhost", f"LOCALHOST:{page.port}", f"[::1]:{page.port}", "192.0.2.7:80"):
        assert page.request("GET", "/assets/base.css", host=host)[0] == 200
        assert page.command("{}", host=host, origin=f"http://{host}")[0] == 204


def test_an_address_that_cannot_be_used_gives_one_line_with_the_remedy():
    app, stream = application("play.html", EventStream()), EventStream()
    with socket.create_server(("127.0.0.1", 0)) as occupied:
        port = occupied.getsockname()[1]
        with pytest.raises(ConfigError, match=rf"^cannot listen on 127.0.0.1, port {port}: .*in use; .*--web 0"):
            serving(app, stream, "127.0.0.1", port).__enter__()
    with pytest.raises(ConfigError, match="--web 70000"):
        serving(app, stream, "127.0.0.1", 70000).__enter__()
    with pytest.raises(ConfigError, match="name an address of this machine"):
        serving(app, stream, "nowhere.invalid", 0).__enter__()
