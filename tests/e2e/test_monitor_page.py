"""The live view in a browser: tables, hostile messages, a restarted server, recordings, a real run with a killed worker."""

import contextlib
import os
import re
import shutil
import signal
import time

import msgpack
import numpy as np
import pytest

from icrl_dist.monitor import variations
from icrl_dist.monitor.drawing import optimum
from icrl_dist.monitor.evaluation import of_rows
from icrl_dist.monitor.feed import LiveFeed
from icrl_dist.monitor.folder import serving_folder
from icrl_dist.monitor.page import serving_run
from icrl_dist.stream import wire
from icrl_dist.stream.memory_link import MemoryHub
from icrl_dist.stream.validation import from_array
from tests.e2e.training import SMOKE, endpoint_of, finish, kill_the_tree, start, wait_for, workers_of
from tests.monitor.fake_feed import run_folder
from tests.monitor.test_evaluation import evaluated
from tests.monitor.test_page import CountingFeed
from tests.optional import known
from tests.results.row_blocks import frame

playwright = pytest.importorskip("playwright.sync_api", reason="playwright is not installed")
CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
pytestmark = pytest.mark.skipif(CHROMIUM is None, reason="no chromium on this machine")
QUIET = (
    "--no-sandbox --disable-gpu --disable-quic --no-first-run --disable-background-networking "
    "--disable-component-update --disable-sync"
)
SHORT_S = 40
MARKUP = '<img src=x onerror="window.__pwned=1;alert(1)">'
ABOUT = {"method": "icaa", "problem": "darkroom", "rounds": 1, "tasks": 1, "variations": 1, "began": 0.0}
ABOUT |= {"phases": [["adapt", 0, 10]]}
CLEAR = "document.querySelector('#connection').textContent === 'live'"


@pytest.fixture(scope="module")
def browser():
    with (
        playwright.sync_playwright() as driver,
        contextlib.closing(driver.chromium.launch(executable_path=CHROMIUM, args=QUIET.split())) as chromium,
    ):
        yield chromium


@pytest.fixture
def page(browser):
    """A page that must log no errors or warnings, except those that match ``page.allowed_errors``."""
    page = browser.new_page(viewport={"width": 1440, "height": 900})
    page.set_default_timeout(1000 * SHORT_S)
    page.timeout_s = SHORT_S
    errors, page.allowed_errors = [], r"(?!)"
    page.on("console", lambda message: errors.append(message.text) if message.type in ("error", "warning") else None)
    page.on("pageerror", lambda error: errors.append(str(error)))

    def dismiss(dialog):
        errors.append(f"dialog: {dialog.message}")
        dialog.dismiss()

    page.on("dialog", dismiss)
    yield page
    assert page.evaluate("window.__pwned") is None
    page.close()
    assert [error for error in errors if not re.search(page.allowed_errors, error)] == []


class MonitorPlane:
    """A monitor plane in this process, and a feed that subscribes to it."""

    def __init__(self, name):
        self.hub = MemoryHub()
        self.link, self.name = self.hub.link(), name
        self.feed = LiveFeed(self.hub.link())
        self.progress()
        wait_for(lambda: self.feed.state.snapshot(0.0)["run"]["name"], "the name of the run", SHORT_S)

    def put(self, payload, topic, run=None):
        self.link.publish(f"icrl/{run or self.name}/mon/{topic}", payload, droppable=True)

    def send(self, kind, **fields):
        self.put(wire.encode_message(kind, **{"time": time.time(), "worker": "w0", **fields}), kind)

    def progress(self, **fields):
        counts = {"round": 0, "step": 5, "steps": 10, "version": 0, "trajectories": 5, "workers": 1, "lag": 0}
        self.send("learner", **{"stage": "collect", "phase": "adapt", "drops": {}, "doing": [], **counts, **fields})

    def send_return(self, *positional, **fields):
        self.put(self.trajectories(*positional, **fields), "trajectories")

    def trajectories(self, variation, trial, total, kind="uniform", problem="darkroom", round=0, p=0.25, **fields):
        room = {"size": 3, "horizon": 8, "goal": [1, 1]}
        adversary = {"kind": kind} if kind == "null" else {"kind": kind, "p": p}
        info = {"problem": problem, "task": room, "adversary": adversary, "policy_version": 0, "weights_digest": "ab" * 32}
        entry = {"identity": f"adapt/{round}/{variation}", **info, "trials": [trial], "returns": [total], "steps": [8]}
        return wire.encode_message("trajectories", **{"worker": "w0", "time": time.time(), "variations": [entry], **fields})

    def close(self):
        self.feed.close()
        self.link.close()


@contextlib.contextmanager
def plane(name="a-run"):
    with contextlib.closing(MonitorPlane(name)) as run:
        yield run


@contextlib.contextmanager
def shown(page, feed):
    """Serves a feed and yields the URL; leaves the page before the server ends, which the page would log as an error."""
    with serving_run(feed, "127.0.0.1", 0) as url:
        yield url
        assert page.evaluate("window.__pwned") is None
        page.goto("about:blank")


def until(page, expression):
    """Wait for an expression.  Playwright's own wait needs eval, which the page's security policy forbids."""
    return wait_for(lambda: page.evaluate(expression), expression, page.timeout_s)


def expect(page, what):
    """Assertions about an element that wait for it to become true; ``what``: a CSS selector or a locator."""
    playwright.expect.set_options(timeout=1000 * page.timeout_s)
    return playwright.expect(page.locator(what) if isinstance(what, str) else what)


def expect_cells(page, column, texts):
    """Wait until the column of the table of variations has these texts, from top to bottom."""
    expect(page, f"#variation-table tbody tr > :nth-child({column})").to_have_text(texts)


def test_sorting_filters_and_the_dialog_of_a_variation(page):
    with plane() as run, shown(page, run.feed) as url:
        for task, total in ((0, 4.0), (1, 6.0), (2, 5.0)):
            for variation, kind in enumerate(("null", "uniform")):
                run.send_return(f"{task}/{variation}", 0, 0.0, kind)
                run.send_return(f"{task}/{variation}", 1, total - variation, kind)
        run.send("event", what="quarantine", text="variation 2/1 ended three workers", identity="adapt/0/2/1")
        states = np.array([[0, 0], [0, 1], [1, 1]], np.float32)
        room = {"size": 3, "horizon": 8, "goal": [1, 1]}
        drawn = {"every": 1, "observations": from_array(states), "adversary": from_array(np.array([-1, 2], "<f4"))}
        run.send("episode", identity="adapt/0/1/1/1", problem="darkroom", task=room, episode_return=5.0, **drawn)
        probs = np.eye(9)[4].tolist()
        run.send("belief", identity="adapt/0/1/1/1", size=3, goal=[1, 1], implied=[1 / 9] * 9, exact=probs)
        run.progress()
        page.goto(url)
        expect_cells(page, 1, ["0/0", "0/1", "1/0", "1/1", "2/0", "2/1 quarantined"])
        last = page.get_by_role("button", name="Last", exact=True)
        last.focus()
        page.keyboard.press("Enter")
        expect_cells(page, 4, ["6", "5", "5", "4", "4", "3"])
        expect(page, "#variation-table th[aria-sort=descending]").to_have_text("Last")
        last.click()
        expect_cells(page, 4, ["3", "4", "4", "5", "5", "6"])
        page.get_by_label("Adversary").select_option("uniform")
        expect_cells(page, 2, ["uniform p 0.25"] * 3)
        page.get_by_label("Task").fill("1")
        expect_cells(page, 1, ["1/1"])
        expect(page, "#variation-count").to_have_text("1 selected of 6")
        page.get_by_role("button", name="Quarantined").click()
        expect_cells(page, 1, [])
        expect(page, "#variation-more").to_contain_text("no variation matches")
        page.get_by_role("button", name="Quarantined").click()

        expect_cells(page, 1, ["1/1"])
        page.locator("#variation-table tbody tr").focus()
        page.keyboard.press("Enter")
        dialog = page.get_by_role("dialog", name="Variation 1/1")
        dialog.get_by_text("uniform: p 0.25").wait_for()
        dialog.get_by_role("button", name="Copy: icrl-dist explain runs/a-run adapt/0/1/1/1").wait_for()
        expect(page, dialog.get_by_role("cell", name="abababababab")).to_have_count(2)
        expected = "1/1: Dark Room, 3 by 3: goal reached after 2 steps, 1 of 2 steps disturbed; return 5"
        dialog.get_by_role("img", name=expected).wait_for()
        page.keyboard.press("Escape")
        dialog.wait_for(state="hidden")
        until(page, "document.activeElement.textContent.startsWith('1/1')")

        page.get_by_role("img", name="Exact posterior: most likely cell 1, 1 with 1; goal at 1, 1").wait_for()
        page.get_by_text("total variation 0.89").wait_for()
        expect(page, "#episodes canvas").to_have_attribute("aria-label", expected)
        page.get_by_role("button", name="Theme: system").click()
        expect(page, "html").to_have_attribute("data-theme", "light")


def test_hostile_messages_are_shown_as_text_or_ignored(page):
    name = MARKUP.replace("/", "").replace("*", "")
    with plane(name) as run, shown(page, run.feed) as url:
        run.progress(doing=[MARKUP], drops={MARKUP: 1})
        counts = dict.fromkeys(("episodes", "steps", "resent", "trajectories", "pid"), 1)
        fields = {"job": MARKUP, "doing": MARKUP, "memory_mb": 1.0, "peak_mb": 1.0}
        run.send("worker", **{**counts, **fields, "worker": MARKUP})
        run.send_return("0/0", 0, 1.0, kind=MARKUP, problem=MARKUP, worker=MARKUP, weights_digest=MARKUP)
        run.send_return("0/0", 2**40, 1.0, kind=MARKUP, problem=MARKUP)
        run.send("event", what=MARKUP, text=MARKUP, time=1e300)
        run.send("event", what="alert", alert=MARKUP, active=True, text=MARKUP)
        run.send("run", **ABOUT | {"method": MARKUP, "problem": MARKUP})
        run.send("run", **ABOUT | {"began": 1e308})
        run.put(b"\xff" * 100, "event")
        run.put(msgpack.packb({"v": wire.VERSION, "kind": "event", "text": "x" * (2 << 20)}), "event")
        run.put(
            msgpack.packb({"v": wire.VERSION, "kind": "trajectories", "variations": [{"returns": [float("nan")]}]}),
            "trajectories",
        )
        run.put(wire.encode_message("event", time=1.0, what="x", text="x"), "event", run="another")
        page.goto(url)
        page.locator("#worker-table").get_by_text(MARKUP).first.wait_for()
        expect(page, "#name").to_have_text(name)
        for where in ("#events", "#alerts", "#drops", "#variation-table", "#adversary-filter"):
            expect(page, where).to_contain_text(MARKUP[:32])
        expect(page, "img").to_have_count(0)
        page.locator("#variation-table tbody tr").click()
        page.locator("#detail-lineage").get_by_text(MARKUP).first.wait_for()
        page.keyboard.press("Escape")
        until(page, "document.querySelector('#ignored').textContent.includes('another run 1')")
        run.send("event", what="version", text="the view still works", version=1)
        page.get_by_text("the view still works").wait_for()


def test_variations_beyond_the_limit_and_a_restarted_server(page, monkeypatch):
    monkeypatch.setattr(variations, "MAX_VARIATIONS", 700)
    page.allowed_errors = r"ERR_(CONNECTION_REFUSED|INCOMPLETE_CHUNKED_ENCODING|CONNECTION_RESET|EMPTY_RESPONSE)"
    with plane() as run:
        run.progress()
        for number in range(1000):  # directly, because a link would drop some
            payload = run.trajectories(f"{number // 8}/{number % 8}", 0, float(number % 97), problem="unknown")
            run.feed.state.receive("icrl/a-run/mon/trajectories/w0", payload, time.time())
        with serving_run(run.feed, "127.0.0.1", 0) as url:
            page.goto(url)
            expect(page, "#variation-table tbody tr").to_have_count(100)
            expect(page, "#variation-more").to_have_text("600 more rows not shown; 300 beyond the limit")
            expect(page, "#variation-count").to_have_text("1,000")
            page.get_by_role("button", name="Last", exact=True).click()
            expect_cells(page, 4, [str(value) for value in range(96, 81, -1) for _ in range(7)][:100])
            page.get_by_role("button", name="Show more").click()
            expect(page, "#variation-table tbody tr").to_have_count(200)
        until(page, f"!({CLEAR})")
        run.send_return("0/0", 1, 1000.0, problem="unknown")
        with serving_run(run.feed, "127.0.0.1", int(url.rstrip("/").rpartition(":")[2])):
            until(page, CLEAR)
            expect(page, page.locator("#variation-table tbody th").first).to_have_text("0/0")


def test_every_round_is_divided_by_its_own_optimum_and_many_alerts_leave_room(page):
    with plane() as run, shown(page, run.feed) as url:
        room = {"size": 3, "horizon": 8, "goal": [1, 1]}
        strengths = {0: 0.1, 1: 0.7}
        best = {n: known(optimum("darkroom", room, {"kind": "uniform", "p": p})) for n, p in strengths.items()}
        for number, p in strengths.items():
            run.send_return("0/0", 0, 0.5 * best[number], round=number, p=p)
        probs = np.eye(9)[4].tolist()
        for worker in ("w0", "w1"):
            run.send("belief", worker=worker, identity="adapt/0/1/1/1", size=3, goal=[1, 1], implied=probs, exact=probs)
        page.goto(url)
        summary = "document.querySelector('#adaptation-summary').textContent"
        until(page, f"/^adapt.1: 0.50 in the first episode.*adapt.0 ended at 0.50[.] Shaded/.test({summary})")
        page.locator("#variation-table tbody tr").click()
        page.locator("#detail-facts").get_by_text("uniform: p 0.1").wait_for()
        optima = re.findall(r"optimal ([\d.]+)", page.locator("#detail-summary").inner_text())
        assert [float(text) for text in optima] == pytest.approx([*best.values()], 0.02)
        page.keyboard.press("Escape")
        expect(page, "#beliefs canvas").to_have_count(4)
        run.send("event", what="worker", text="w1 is gone", worker="w1", alive=False)
        expect(page, "#beliefs canvas").to_have_count(2)

        for number in range(100):
            run.send("event", what="alert", alert=f"silent w{number}", active=True, text=f"worker w{number} is silent")
        expect(page, "#alerts p").to_have_count(100)
        alerts, table = page.locator("#alerts"), page.locator("#variation-table")
        assert alerts.bounding_box()["height"] <= 900 / 4 and table.bounding_box()["height"] > 80
        alerts.focus()
        expect(page, alerts).to_be_focused()
        page.keyboard.press("End")
        until(page, "document.querySelector('#alerts').scrollTop > 1000")
        run.send("run", **ABOUT, alerts=[])  # the list in a run message replaces the alerts
        expect(page, "#alerts p").to_have_count(0)


def test_what_the_run_is_worth_alerts_and_a_filter_that_matches_nothing(page):
    with plane() as run, shown(page, run.feed) as url:
        for trial in (0, 1, 2, 5, 6):  # 3 and 4 are missing
            run.send_return("0/0", trial, 1.0 + trial, problem="unknown")
        for trial in range(4):
            run.send_return("0/1", trial, 2.0, problem="unknown")
        run.send("run", **ABOUT | {"rounds": 2})
        page.goto(url)
        expect(page, "#headline").to_contain_text("Round 1 of 2 (adapt/0), ")
        expect(page, "#stage").to_have_text("adapt/0: rollouts of T^0")
        expect(page, "#round").to_have_text("1 of 2 (adapt/0)")
        expect(page, "#adaptation-summary").to_contain_text("mean of 1 variation in episodes 1 to 4 (n = 1 of 2)")
        expect(page, "#adaptation-summary").to_contain_text("earlier episodes are missing")
        line = page.locator("#variation-table tbody tr").first.locator("path")
        assert line.get_attribute("d").count("M") == 2, "no line across the missing episodes"
        page.get_by_label("Task").fill("7")
        expect(page, "#adaptation-summary").to_have_text("No variation matches the filters.")
        expect(page, "#adaptation canvas").to_have_count(0)
        page.get_by_label("Task").fill("")
        expect(page, "#adaptation canvas").to_have_count(1)

        run.send("event", what="alert", alert="zero", active=True, text="no returns")
        expect(page, "#state").to_have_text("collecting, 1 alert")
        until(page, "document.title === '(1 alert) a-run: collecting'")
        expect(page, "#heldout").to_be_hidden()
        run.send("event", what="finished", text="done")
        run.feed.state.set_evaluation(None, True)
        expect(page, "#heldout-note").to_have_text("The evaluation on held-out tasks is running.")
        until(page, "document.title === '(1 alert) a-run: evaluating'")
        run.feed.state.set_evaluation(of_rows(frame(*evaluated(0.0), *evaluated(3.0, p=0.2))), False)
        expect(page, "#headline").to_contain_text(" of oracle, T^0 ")
        expect(page, "#heldout-table tbody th").to_have_text(["T^2 (dpt)", "T^0", "random", "oracle"])
        expect(page, "#heldout-note").to_contain_text("T^2 (dpt): higher than T^0 (difference ")
        page.get_by_label("Strength p").select_option("p = 0")
        expect(page, "#heldout-note").to_contain_text("T^2 (dpt): a difference from T^0 is not shown")
        expect(page, "#heldout-note").to_contain_text("one training: nothing is claimed beyond it. 1 further reference")
        assert page.locator(".key", has_text="random, held-out").count() == 1, "no optimum: returns stand beside references"


def test_a_recording_is_controlled_by_keyboard(page):
    run = CountingFeed()
    run.recording = {"begin": 1000.0, "end": 1100.0, "at": 1010.0, "speed": 10.0, "paused": False}
    run.tick()
    with shown(page, run) as url:
        page.goto(url)
        button = page.locator("#pause")
        button.wait_for()  # hidden until the first snapshot is in; a hidden button cannot have the focus
        button.focus()
        page.keyboard.press("Enter")
        expect(page, button).to_have_text("Play")
        page.get_by_label("Speed").select_option("50")
        wait_for(lambda: len(run.controls) == 2, "the speed", page.timeout_s)
        page.get_by_label("Position in the recording").press("End")
        expect(page, button).to_have_text("Play again")
        button.press("Enter")
        expect(page, button).to_have_text("Pause")
        assert run.controls == [{"paused": True}, {"speed": 50}, {"at": 1100}, {"at": 1000, "paused": False}]


def test_a_real_run_and_a_killed_worker(page, tmp_path):
    folder = tmp_path / "watched"
    many = ("--pretrain.steps", "5", "--icaa.rounds", "2000", "--icaa.steps", "5")  # more than the test sees
    training = start("train", *SMOKE, *many, "--out", folder, start_new_session=True)
    view = None
    try:
        endpoint_of(folder)
        view = start("monitor", folder, "--web", "0")
        url = next(found[0] for line in view.stdout if (found := re.search(r"http://\S+", line)))
        page.set_default_timeout(120_000)
        page.timeout_s = 120
        page.goto(url)
        expect(page, "#worker-table tbody tr[data-state=working]").to_have_count(2)
        expect(page, "#variation-count").to_have_text("14")
        expect(page, "#variation-table tbody tr").to_have_count(14)  # 7 tasks, 2 variations

        grown = "Number(document.querySelector('#variation-table tbody tr:nth-child(2) > :last-child').textContent)"
        until(page, f"{grown} > 0")
        before = page.evaluate(grown)
        until(page, f"{grown} !== {before}")
        # Only variations that have started the newest round and whose optimum in it is computed.
        summary = "document.querySelector('#adaptation-summary').textContent"
        until(page, f"/mean of (8|9|1[0-4]) variations/.test({summary})")
        expect(page, "#adaptation canvas").to_have_count(1)

        victim = workers_of(training)[0]
        training.send_signal(signal.SIGSTOP)  # delays the restart of the worker; the learner continues
        os.kill(victim.pid, signal.SIGKILL)
        killed = time.monotonic()
        troubled = "#worker-table tbody tr.troubled"
        row = page.wait_for_selector(f"{troubled}[data-state=gone]")
        print(f"red after {time.monotonic() - killed:.2f} s")
        name, state = row.query_selector("th").inner_text(), row.query_selector(".badge").inner_text()
        assert state == "gone" and name in ("w0", "w1")
        colors = "e => [getComputedStyle(e.querySelector('.badge')).color, getComputedStyle(document.body).color]"
        assert len(set(row.evaluate(colors))) == 2
        training.send_signal(signal.SIGCONT)
        page.wait_for_selector(f"#worker-table tbody tr:has-text('{name}-1')[data-state=working]")
        print(f"back after {time.monotonic() - killed:.2f} s")
        rows = "document.querySelectorAll('#worker-table tbody tr').length"
        until(page, f"document.querySelectorAll('{troubled}').length === 0 && {rows} === 2")
    finally:
        if view is not None:
            page.goto("about:blank")  # before the server ends, which the page would log as an error
            view.send_signal(signal.SIGINT)
            assert finish(view) is not None and view.returncode == 0
        kill_the_tree(training)


def test_a_folder_of_runs_is_followed_and_two_are_compared(page, tmp_path):
    folder, odd = tmp_path / "runs", MARKUP.replace("/", "")
    page.allowed_errors = r"status of (404|503)"  # a run is asked for before its files are written, or after it is gone
    with serving_folder(folder, "127.0.0.1", 0) as url:
        page.goto(url)
        expect(page, "#headline").to_contain_text(f"Waiting for the first run in {folder}")
        expect(page, "#runs-note").to_have_text("No run yet: the first one is shown when it begins.")
        run_folder(folder / "first")
        expect(page, "#name").to_have_text("first")
        expect(page, "#headline").to_contain_text("Training finished")
        run_folder(folder / "second")
        expect(page, "#name").to_have_text("second")
        expect(page, "#run-table tbody th").to_have_text(["second", "first"])
        expect(page, "#run-table tbody tr.shown th").to_have_text("second")

        page.get_by_role("button", name="Compare second with first").click()
        expect(page, "#compare-names").to_have_text("second and first")
        expect(page, "#compare-training .key").to_have_text(
            [re.compile("^episode"), re.compile(r"^second \(adapt/0\)"), re.compile("^first")]
        )
        colors = page.eval_on_selector_all("#compare-training .swatch", "all => all.map((one) => one.style.color)")
        assert len(set(colors)) == 2
        expect(page, "#compare-training-note").to_contain_text("second: n = 6 of 6 variations; first: n = 6 of 6 variations")
        expect(page, "#compare-table thead th").to_have_text(["second", "first"])
        wide = "[...document.querySelectorAll('body, .card, .scroll')].filter((e) => e.scrollWidth > e.clientWidth + 1).length"
        for width, height in ((1280, 720), (1440, 900), (2560, 1440)):
            page.set_viewport_size({"width": width, "height": height})
            until(page, "document.querySelector('#compare-training canvas').clientHeight > 100")
            until(page, f"{wide} === 0")

        page.locator("#run-table tbody tr").nth(1).click()
        expect(page, "#name").to_have_text("first")
        expect(page, "#comparison").to_be_hidden()
        run_folder(folder / "third")
        (folder / odd).mkdir()
        (folder / odd / "run.toml").touch()
        expect(page, "#run-table tbody tr").to_have_count(4)
        expect(page, "#run-table").to_contain_text(odd)
        expect(page, "#name").to_have_text("first")  # chosen, so it is not replaced
        page.reload()
        expect(page, "#name").to_have_text("first")
        shutil.rmtree(folder / odd)
        page.get_by_role("button", name="Follow the newest").click()
        expect(page, "#name").to_have_text("third")
        page.locator("#variation-table tbody tr").first.click()
        page.get_by_role("button", name=f"Copy: icrl-dist explain {folder}/third adapt/0/").first.wait_for()
        page.keyboard.press("Escape")
        page.get_by_label("Position in the recording").press("Home")
        expect(page, "#at").to_contain_text("0:0")
        page.goto("about:blank")
