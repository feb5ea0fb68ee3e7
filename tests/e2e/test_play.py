"""``icrl-dist play`` in a browser: a person moves the goal and overrides actions, and the agent adapts."""

import contextlib
import json
import os
import re
import signal
import subprocess
import sys
import threading
import urllib.error
import urllib.request
from pathlib import Path

import pytest

from icrl_dist.monitor.event_stream import EventStream
from icrl_dist.monitor.serve import application, serving
from tests.e2e.training import wait_for
from tests.optional import known
from tests.problems.darkroom.fixed_agent import game

playwright = pytest.importorskip("playwright.sync_api", reason="needs playwright")

CHROMIUM = Path("/usr/bin/chromium")
QUIET = (
    *("--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run", "--disable-sync"),
    *("--disable-background-networking", "--disable-component-update"),
)
TIMEOUT_MS = 60_000

pytestmark = pytest.mark.skipif(not CHROMIUM.exists(), reason=f"needs a browser at {CHROMIUM}")


@pytest.fixture(scope="module")
def served():
    command = [sys.executable, "-m", "icrl_dist.cli", "play", "--pretrained", "darkroom", "--web", "0", "--paused"]
    environment = {**os.environ, "OMP_NUM_THREADS": "1"}
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=environment)
    url = known(process.stdout).readline().partition(": ")[0]
    yield process, url
    if process.poll() is None:
        process.send_signal(signal.SIGINT)
    _, errors = process.communicate(timeout=120)
    assert process.returncode == 130 and not errors


@pytest.fixture(scope="module")
def browser():
    with playwright.sync_playwright() as p:
        browser = p.chromium.launch(executable_path=str(CHROMIUM), args=list(QUIET))
        yield browser
        browser.close()


@contextlib.contextmanager
def opened(browser, url):
    """A page of the game that must log no errors."""
    page, errors = browser.new_page(viewport={"width": 1000, "height": 700}), []
    page.set_default_timeout(TIMEOUT_MS)
    page.on("console", lambda message: errors.append(message.text) if message.type == "error" else None)
    page.on("pageerror", lambda error: errors.append(str(error)))
    page.goto(url)
    yield page
    assert not errors
    page.close()


@contextlib.contextmanager
def viewer(browser, url):
    """The same, once it shows the whole state of the game."""
    with opened(browser, url) as page:
        expect(page, "#status").to_have_text("live")
        yield page


def labelled(page, what, text):
    """Wait until the label of an element contains this text."""
    expect(page, what).to_have_attribute("aria-label", contains(text))


def expect(page, what):
    playwright.expect.set_options(timeout=TIMEOUT_MS)
    return playwright.expect(page.locator(what))


def finish(page, episode):
    """Play to the end of an episode; its return, the expected optimum, and the number of overridden steps."""
    page.click("#through")
    expect(page, "#returns tr").to_have_count(episode)
    cells = page.locator("#returns tr").first.locator("td").all_text_contents()
    assert cells[0] == str(episode)
    return [float(text) for text in cells[1:4]]


def painted(page, color):
    """Number of the room's pixels in a color of the theme."""
    script = """(name) => {
        const probe = document.createElement("span");
        document.body.append(probe);
        probe.style.color = `var(${name})`;
        const wanted = getComputedStyle(probe).color.match(/\\d+/g).map(Number);
        probe.remove();
        const room = document.getElementById("room");
        const data = room.getContext("2d").getImageData(0, 0, room.width, room.height).data;
        let count = 0;
        for (let i = 0; i < data.length; i += 4) if (wanted.every((c, k) => Math.abs(c - data[i + k]) < 40)) count++;
        return count;
    }"""
    return page.evaluate(script, color)


def test_the_agent_adapts_to_a_moved_goal_and_overrides(served, browser):
    _, url = served
    with viewer(browser, url) as page:
        labelled(page, "#room", "A room of 10 by 10 cells. Agent at (0, 0), goal at (5, 7)")
        undisturbed = [finish(page, episode) for episode in (1, 2)]
        assert [optimum for _, optimum, _ in undisturbed] == [89.0, 89.0] and undisturbed[1][0] > 80
        assert painted(page, "--series-2") == 0

        room = page.locator("#room")
        box = room.bounding_box()
        room.click(position={"x": 0.25 * box["width"], "y": 0.75 * box["height"]})
        labelled(page, "#room", "goal at (2, 2)")
        page.locator("#p").fill("0.5")
        disturbed = [finish(page, episode) for episode in range(3, 9)]
        returns, optima, overridden = zip(*disturbed, strict=True)
        assert set(optima) == {45.7}
        assert all(30 < count < 70 for count in overridden) and painted(page, "--series-2") > 100
        assert sum(returns[2:]) / 4 > 0.8 * optima[0], "at least 80% of the optimum from the third episode on"
        labelled(page, "#implied", "most likely (2, 2)")
        labelled(page, "#exact", "most likely (2, 2) with 100 %")
        expect(page, "#surprise").to_have_attribute("aria-valuetext", contains("training"))
        with viewer(browser, url) as other:
            expect(other, "#returns tr").to_have_count(8)
            expect(other, "#p-text").to_have_text("0.50")
            other.click("#new")
            expect(page, "#returns tr").to_have_count(0)


def test_the_page_works_by_keyboard(served, browser):
    _, url = served
    with viewer(browser, url) as page:
        page.focus("#new")
        page.keyboard.press("Enter")
        expect(page, "#step").to_have_text("0 of 100")
        page.focus("#room")
        page.keyboard.press("ArrowUp")
        page.focus("#one")
        page.keyboard.press("Enter")
        expect(page, "#step").to_have_text("1 of 100")
        expect(page, "#overridden").to_have_text("1 (1 you)")
        labelled(page, "#room", "Agent at (0, 1)")
        assert painted(page, "--series-4") > 10
        page.fill("#goal-x", "9")
        page.fill("#goal-y", "1")
        page.keyboard.press("Enter")
        labelled(page, "#room", "goal at (9, 1)")
        before = page.evaluate("getComputedStyle(document.body).backgroundColor")
        for _ in range(2):
            page.click("#theme")
        expect(page, "#theme").to_have_text("Theme: dark")
        expect(page, "body").not_to_have_css("background-color", before)
        page.click("#pause")
        expect(page, "#step").not_to_have_text("1 of 100")
        page.click("#pause")
        expect(page, "#pause").to_have_text("Resume")
        unlabelled = "button:not([aria-label]):empty, canvas[id]:not([aria-label]):not([aria-hidden])"
        expect(page, unlabelled).to_have_count(0)


def test_the_page_is_live_once_it_shows_the_whole_state(browser, small_run):
    played, stream = game(small_run), EventStream()
    with serving(application("play.html", stream), stream, "127.0.0.1", 0) as url, opened(browser, url) as page:
        stream.publish("episodes", played.history(), state=True)
        labelled(page, "#chart", "no episode has ended yet")
        assert page.text_content("#status") == "connecting"
        stream.publish("room", played.snapshot(), state=True)
        labelled(page, "#room", "A room of 3 by 3 cells")
        assert page.text_content("#status") == "connecting"
        uniform = [1 / 9] * 9
        figures = {"apart": 0.0, "divergence": 0.0, "transitions": 0}
        stream.publish("belief", {"implied": uniform, "exact": uniform, **figures}, state=True)
        expect(page, "#status").to_have_text("live")


def test_a_command_is_sent_after_the_answer_to_the_one_before_it(browser, small_run):
    arrived, second, overlapped = [], threading.Event(), []

    def command(fields):
        arrived.append(fields["do"])
        if len(arrived) == 1:
            overlapped.append(second.wait(1.0))
        else:
            second.set()

    stream = EventStream()
    with serving(application("play.html", stream, command), stream, "127.0.0.1", 0) as url, opened(browser, url) as page:
        page.locator("#p").fill("0.5")
        page.click("#one")
        wait_for(second.is_set, "the second command")
    assert arrived == ["p", "step"] and overlapped == [False]


def test_values_of_a_slider_replace_each_other_while_they_wait(browser):
    arrived, moved = [], threading.Event()

    def command(fields):
        arrived.append((fields["do"], fields.get("value")))
        moved.wait(TIMEOUT_MS / 1000)

    stream = EventStream()
    with serving(application("play.html", stream, command), stream, "127.0.0.1", 0) as url, opened(browser, url) as page:
        page.locator("#p").fill("0.1")
        wait_for(lambda: arrived, "the first command")
        for p in ("0.2", "0.3", "0.4"):
            page.locator("#p").fill(p)
        page.click("#one")
        page.locator("#p").fill("0.5")
        moved.set()
        wait_for(lambda: len(arrived) == 4, "all commands")
    assert arrived == [("p", 0.1), ("p", 0.4), ("step", None), ("p", 0.5)]


def test_hostile_commands_are_refused_and_the_game_continues(served):
    _, url = served

    def post(body, **headers):
        request = urllib.request.Request(f"{url}command", body, {"content-type": "application/json", **headers}, method="POST")
        try:
            with urllib.request.urlopen(request, timeout=30) as answer:
                return answer.status, b""
        except urllib.error.HTTPError as error:
            with error:
                return error.code, error.read()

    assert post(b'{"do": "new"}', origin="http://evil.example")[0] == 403
    assert post(b'{"do": "new"}', host="evil.example")[0] == 403
    assert post(b'{"do": "new"}', **{"content-type": "text/plain"})[0] == 415
    assert post(b'{"do": "new"' + b" " * 5000 + b"}")[0] == 413
    for body in (b"", b"\x00\xff", b'{"do": "p", "value": 1e999}', b'{"do": "goal", "value": [10, 0]}', b'{"do": "__init__"}'):
        status, answer = post(body)
        assert status == 400 and len(json.loads(answer)["error"].splitlines()) == 1
    assert post(b'{"do": "pause", "value": true}', origin=url.rstrip("/"))[0] == 204


def contains(text):
    return re.compile(re.escape(text))
