"""The live view's server: events to several viewers, commands from its own page only."""

import asyncio
import http.client
import json
import socket
import threading
import time
from urllib.parse import urlsplit

import pytest

from icrl_dist.config.run import ConfigError
from icrl_dist.monitor import serve
from icrl_dist.monitor.serve import EventStream, application, serving


class Page:
    """A page with an echo for a command."""

    def __init__(self, url, stream, heard):
        self.stream, self.heard = stream, heard
        self.host, self.port = urlsplit(url).hostname, urlsplit(url).port

    def ask(self, method, path, body=None, **headers):
        connection = http.client.HTTPConnection(self.host, self.port, timeout=5)
        try:
            connection.request(method, path, body, {name.replace("_", "-"): value for name, value in headers.items()})
            answer = connection.getresponse()
            return answer.status, dict(answer.getheaders()), answer.read()
        finally:
            connection.close()

    def order(self, body, **headers):
        headers = {"content_type": "application/json", **headers}
        status, _, text = self.ask("POST", "/command", body, **headers)
        return status, text.decode()

    def watch(self):
        connection = http.client.HTTPConnection(self.host, self.port, timeout=5)
        connection.request("GET", "/events")
        return Viewer(connection, connection.getresponse())


class Viewer:
    def __init__(self, connection, answer):
        self.connection, self.answer = connection, answer

    def next(self):
        """The next event: its name and data; None at the end."""
        event = None
        while line := self.answer.readline():
            field, _, value = line.decode().strip().partition(": ")
            if field == "event":
                event = value
            elif field == "data":
                return event, json.loads(value)
        return None


@pytest.fixture
def page():
    stream, heard = EventStream(), []

    def command(fields):
        if "bad" in fields:
            raise ValueError(f"bad={fields['bad']}: not that")
        heard.append(fields)

    with serving(application("play.html", stream, command), stream, "127.0.0.1", 0) as url:
        yield Page(url, stream, heard)


def wait_for(condition):
    deadline = time.monotonic() + 5
    while not condition():
        assert time.monotonic() < deadline
        time.sleep(0.005)


def test_every_viewer_hears_the_state_first_and_then_what_happens(page):
    page.stream.publish("room", {"step": 1}, state=True)
    page.stream.publish("said", {"to": "nobody"})
    viewers = [page.watch() for _ in range(3)]
    wait_for(lambda: page.stream.viewers == 3)
    page.stream.publish("said", {"to": "all"})
    for viewer in viewers:
        assert viewer.next() == ("room", {"step": 1})
        assert viewer.next() == ("said", {"to": "all"})
        viewer.connection.close()
        viewer.answer.close()
    wait_for(lambda: page.stream.publish("said", 0) is None and page.stream.viewers == 0)


def test_a_slow_viewer_misses_the_oldest_and_no_state():
    async def slow():
        viewer = serve._Viewer(asyncio.get_running_loop())
        for number in range(serve.QUEUED + 50):
            viewer.put("said", str(number), False)
            viewer.put("room", str(number), True)
        return await viewer.next()

    lines = [line for line in asyncio.run(slow()).splitlines() if line.startswith("data")]
    said = range(51, serve.QUEUED + 50)
    assert lines == [*(f"data: {number}" for number in said), f"data: {serve.QUEUED + 49}"]


def test_no_more_viewers_than_there_is_room_for(page, monkeypatch):
    monkeypatch.setattr(serve, "VIEWERS", 1)
    first = page.watch()
    wait_for(lambda: page.stream.viewers == 1)
    assert page.ask("GET", "/events")[0] == 503
    first.connection.close()
    first.answer.close()


def test_the_end_reaches_every_viewer_and_ends_the_threads():
    before = threading.active_count()
    stream = EventStream()
    with serving(application("play.html", stream), stream, "127.0.0.1", 0) as url:
        viewer = Page(url, stream, []).watch()
        wait_for(lambda: stream.viewers == 1)
    assert viewer.next() is None
    viewer.connection.close()
    viewer.answer.close()
    assert threading.active_count() == before


def test_every_answer_forbids_foreign_scripts(page):
    for path, status in (
        ("/assets/base.css", 200),
        ("/nowhere", 404),
        ("/assets/serve.py", 404),
        ("/assets/..%2fserve.py", 404),
    ):
        found, headers, _ = page.ask("GET", path)
        assert found == status
        policy = headers["content-security-policy"]
        assert policy.startswith("default-src 'none'; script-src 'self'; style-src 'self'") and "unsafe" not in policy
        assert headers["x-content-type-options"] == "nosniff"


def test_a_command_is_one_small_json_object(page):
    assert page.order('{"p": 0.5}') == (204, "")
    assert page.heard == [{"p": 0.5}]
    assert page.order('{"bad": 3}') == (400, '{"error":"bad=3: not that"}')
    for body in ("", "[]", "nonsense", '{"p": NaN}', '{"p": Infinity}', b'{"p": "\xff"}', "[" * 4000):
        status, text = page.order(body)
        assert status == 400 and len(json.loads(text)["error"].splitlines()) == 1, body
    assert page.order("x" * (serve.BODY + 1))[0] == 413
    assert page.order('{"p": 1}', content_type="text/plain")[0] == 415
    assert page.ask("GET", "/command")[0] == 405
    assert page.heard == [{"p": 0.5}]


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
def test_a_foreign_page_commands_nothing(page, headers):
    status, text = page.order('{"p": 1}', **headers)
    assert status == 403 and len(text.splitlines()) == 1
    assert not page.heard


def test_a_foreign_name_sees_nothing_either(page):
    for host in ("evil.example", f"evil.example:{page.port}", "[evil]"):
        assert page.ask("GET", "/events", host=host)[0] == 403
    for host in ("localhost", f"LOCALHOST:{page.port}", f"[::1]:{page.port}", "192.0.2.7:80"):
        assert page.ask("GET", "/assets/base.css", host=host)[0] == 200
        assert page.order("{}", host=host, origin=f"http://{host}")[0] == 204


def test_a_port_that_is_taken_is_said_in_a_line_with_the_remedy():
    app, stream = application("play.html", EventStream()), EventStream()
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        with pytest.raises(ConfigError, match=rf"^cannot listen on 127.0.0.1, port {port}: .*in use; .*--web 0"):
            serving(app, stream, "127.0.0.1", port).__enter__()
    with pytest.raises(ConfigError, match="--web 70000"):
        serving(app, stream, "127.0.0.1", 70000).__enter__()
    with pytest.raises(ConfigError, match="name an address of this machine"):
        serving(app, stream, "nowhere.invalid", 0).__enter__()
