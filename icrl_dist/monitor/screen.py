"""The live view in a terminal."""

from __future__ import annotations

import asyncio
import signal
import time
from collections.abc import Callable, Iterator
from typing import Any, ClassVar

from textual.app import App
from textual.binding import Binding, BindingType
from textual.containers import Horizontal, Vertical
from textual.widget import Widget
from textual.widgets import Input

from icrl_dist.monitor import detail, panes
from icrl_dist.monitor.feed import Feed
from icrl_dist.monitor.lines import DIM, Scroll
from icrl_dist.monitor.overlays import HELP, Detail, Help, Overlay
from icrl_dist.monitor.panes import Header, Keys, Tabs
from icrl_dist.monitor.tables import VARIATIONS, WORKERS, Table, worker_row
from icrl_dist.monitor.view_state import ViewState

PERIOD_S = 0.25
"""Time between two updates of the view; longer if an update takes long."""
_REPLACED_S = 2.0
"""Time between two questions whether another run is to be shown."""
_REST = 8
"""Ratio of the time between updates to the time that an update takes."""
_ROOMY = (110, 36)
"""Columns and lines from which on all panes are shown at once."""
_PANES = ("variations", "workers", "rates", "events")
INTERRUPTED = 130


class MonitorApp(App[None]):
    """One run, live or from a recording."""

    ENABLE_COMMAND_PALETTE = False
    TITLE = "icrl-dist monitor"
    CSS = """
    Screen { background: #11151c; color: #d6dbe5; }
    #header { height: 2; background: #1b2230; }
    #tabs, #keys { height: 1; background: #1b2230; }
    #typed { height: 1; border: none; padding: 0 1; background: #1b2230; display: none; }
    #sheet, #body { height: 1fr; }
    #left { width: 7fr; }
    #right { width: 4fr; margin-left: 2; }
    #variations { height: 3fr; }
    #workers { height: 1fr; min-height: 6; margin-top: 1; }
    #rates { height: 11; }
    #events { height: 1fr; margin-top: 1; }
    .one #left, .one #right { width: 1fr; margin: 0; }
    .one .pane { height: 1fr; margin: 0; }
    """
    BINDINGS: ClassVar[list[BindingType]] = [
        Binding("ctrl+c", "interrupt", priority=True),
        Binding("tab", "pane(1)", priority=True),
        Binding("shift+tab", "pane(-1)", priority=True),
        *(Binding(str(i + 1), f"show({i})") for i in range(len(_PANES))),
        Binding("q", "quit"),
        Binding("p,space", "freeze"),
        Binding("s", "sort"),
        Binding("S", "reverse"),
        Binding("slash", "filter"),
        Binding("escape", "clear", priority=True),
        Binding("question_mark", "help"),
        Binding("plus,equals_sign", "speed(2.0)"),
        Binding("minus", "speed(0.5)"),
        Binding("left", "seek(-1)"),
        Binding("right", "seek(1)"),
        Binding("left_square_bracket", "neighbor(-1)"),
        Binding("right_square_bracket", "neighbor(1)"),
    ]

    def __init__(self, feed: Feed, replaced: Callable[[], bool] = lambda: False) -> None:
        """``replaced``: whether another run is to be shown instead; the view then ends without a result."""
        super().__init__()
        self._feed, self._replaced = feed, replaced
        self.replaced = False
        self._view = ViewState(feed.state)
        self._frozen: float | None = None
        self._active = 0
        self._not_before = 0.0
        self._laid_out = False

    def compose(self) -> Iterator[Widget]:
        yield Header("header")
        yield Tabs("tabs")
        with Horizontal(id="body"):
            with Vertical(id="left"):
                yield Table("variations", VARIATIONS)
                yield Table("workers", WORKERS)
            with Vertical(id="right"):
                yield Scroll("rates")
                yield Scroll("events", follow=True)
        yield Input(id="typed", placeholder="task 3, task 3/1, dirichlet, quarantined, ...", select_on_focus=False)
        yield Keys("keys")

    def on_mount(self) -> None:
        for name in _PANES:
            self.query_one(f"#{name}").add_class("pane")
        self.query_one(Input).cursor_blink = False
        for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
            try:
                asyncio.get_running_loop().add_signal_handler(number, self.action_interrupt)
            except (ValueError, RuntimeError):  # only the main thread handles signals
                break
        self._laid_out = True
        self._arrange()
        self.set_interval(PERIOD_S, self._tick)
        self.set_interval(_REPLACED_S, self._leave_if_replaced)
        self.update_view()

    # Content of the widgets.

    def _tick(self) -> None:
        began = time.monotonic()
        if began >= self._not_before:
            self.update_view()
            self._not_before = began + (time.monotonic() - began) * (1 + _REST)

    def _leave_if_replaced(self) -> None:
        if self._frozen is None and self._replaced():
            self.replaced = True
            self.exit()

    def update_view(self) -> None:
        """Show the newest state, unless the view is frozen."""
        if self._frozen is None:
            self._view.update(self._feed.now())
        self._fill()

    def _fill(self) -> None:
        """Fill every visible widget."""
        if not self.screen_stack or not self.screen.query(Keys):
            return  # the screen is not composed yet, or is being closed
        replay = self._feed.replay()
        self.screen.query_one(Header).fill(self._view, replay, self._frozen, not self._roomy())
        self.screen.query_one(Keys).fill(self._keys(replay))
        if isinstance(self.screen, Help):
            self.screen.query_one(Scroll).fill([], HELP)
        elif isinstance(self.screen, Detail):
            self._fill_detail(self.screen)
        else:
            self._fill_panes()

    def _fill_detail(self, page: Detail) -> None:
        if self._frozen is not None and page.filled == page.variation:
            return
        known, sheet = self._feed.state.variation(page.variation), page.query_one(Scroll)
        if known is not None:
            sheet.fill(*detail.lines(known, sheet.size.width or self.size.width))
        else:
            sheet.fill([], [[(f" {page.variation}: no episode yet", DIM)]])
        page.filled = page.variation

    def _fill_panes(self) -> None:
        view = self._view
        if (pane := self._pane("variations")).display:
            assert isinstance(pane, Table)
            pane.note = f"{view.left_out:,} more are not kept" if view.left_out else ""
            pane.fill(view.variations.values())
        if (pane := self._pane("workers")).display:
            assert isinstance(pane, Table)
            pane.fill(worker_row(row) for row in view.workers)
        for name, lines in (("rates", panes.rate_lines), ("events", panes.event_lines)):
            if (pane := self._pane(name)).display:
                assert isinstance(pane, Scroll)
                pane.fill(*lines(view, pane.size.width or 40, pane.size.height, pane.has_focus))
        if self.query_one(Tabs).display:
            counts = (len(view.variations), len(view.workers), None, len(view.events))
            names = [name if n is None else f"{name} {n:,}" for name, n in zip(_PANES, counts, strict=True)]
            self.query_one(Tabs).fill(names, self._active)

    def _keys(self, replay: dict[str, Any] | None) -> list[tuple[str, str]]:
        if replay:
            freeze, recording = ("p", "play" if replay["paused"] else "pause"), [("+-", "speed"), ("←→", "seek")]
        else:
            freeze, recording = ("p", "unfreeze" if self._frozen else "freeze"), []
        if isinstance(self.screen, Overlay):
            neighbors = [("[ ]", "previous, next")] if isinstance(self.screen, Detail) else []
            return [("Esc", "back"), ("↑↓", "scroll"), *neighbors, freeze, *recording, ("q", "quit")]
        table = [("s", "sort"), ("/", "filter"), ("⏎", "open"), ("Tab", "next")]
        return [("q", "quit"), freeze, *table, *recording, ("?", "help")]

    def _pane(self, name: str) -> Widget:
        return self.screen_stack[0].query_one(f"#{name}")

    def on_resize(self) -> None:
        if self._laid_out:
            self._arrange()
            self.call_after_refresh(self._fill)

    def _roomy(self) -> bool:
        return self.size.width >= _ROOMY[0] and self.size.height >= _ROOMY[1]

    def _arrange(self) -> None:
        """Show all panes if the terminal is large enough, else only the active one."""
        roomy = self._roomy()
        base = self.screen_stack[0]
        base.set_class(not roomy, "one")
        base.query_one(Tabs).display = not roomy
        for i, name in enumerate(_PANES):
            self._pane(name).display = roomy or i == self._active
        base.query_one("#left").display = roomy or self._active < 2
        base.query_one("#right").display = roomy or self._active >= 2
        self._pane(_PANES[self._active]).focus()

    # Actions of the keys.

    def check_action(self, action: str, parameters: tuple[object, ...]) -> bool | None:
        """Whether a key acts now: some keys are for tables, some for overlays, and a filter takes keys as letters."""
        if action in ("pane", "show", "sort", "reverse", "filter"):
            return not isinstance(self.screen, Overlay) and not self._typing()
        if action in ("speed", "seek"):
            return self._feed.replay() is not None and not self._typing()
        if action == "neighbor":
            return isinstance(self.screen, Detail)
        return True

    def _typing(self) -> bool:
        return isinstance(self.focused, Input)

    def action_interrupt(self) -> None:
        """Quit with the exit code of Ctrl-C."""
        self.exit(return_code=INTERRUPTED)

    def action_pane(self, step: int) -> None:
        self.action_show((self._active + step) % len(_PANES))

    def action_show(self, number: int) -> None:
        self._active = number
        self._arrange()
        self.call_after_refresh(self._fill)

    def action_freeze(self) -> None:
        """Pause or resume a recording; freeze or unfreeze the view of a live run."""
        replay = self._feed.replay()
        if replay is not None:
            self._feed.control(paused=not replay["paused"])
        else:
            self._frozen = self._feed.now() if self._frozen is None else None
        self.update_view()

    def _table(self) -> Table | None:
        pane = self._pane(_PANES[self._active])
        return pane if isinstance(pane, Table) else None

    def action_sort(self) -> None:
        if table := self._table():
            table.sort_next()

    def action_reverse(self) -> None:
        if table := self._table():
            table.sort_reverse()

    def action_filter(self) -> None:
        if table := self._table():
            typed = self.query_one(Input)
            typed.display, typed.value = True, table.filter
            typed.focus()

    def on_input_changed(self, event: Input.Changed) -> None:
        if (table := self._table()) and self._typing():
            table.filter = event.value
            table.redraw()

    def on_input_submitted(self) -> None:
        self._close_input()

    def _close_input(self) -> None:
        self.query_one(Input).display = False
        self._pane(_PANES[self._active]).focus()

    def action_clear(self) -> None:
        """Close an overlay; in a table, remove the filter."""
        if isinstance(self.screen, Overlay):
            self.pop_screen()
            self.call_after_refresh(self._fill)
            return
        if table := self._table():
            table.filter = ""
            table.redraw()
        if self._typing():
            self._close_input()

    def action_help(self) -> None:
        self._open(Help())

    def on_table_opened(self, event: Table.Opened) -> None:
        if self._active == 0:
            self._open(Detail(event.row))

    def _open(self, page: Overlay) -> None:
        if not isinstance(self.screen, type(page)):
            self.push_screen(page)
            self.call_after_refresh(self._fill)

    def action_neighbor(self, step: int) -> None:
        if isinstance(self.screen, Detail):
            table = self._pane("variations")
            assert isinstance(table, Table)
            self.screen.variation = table.move(step) or self.screen.variation
            self._fill()

    def action_speed(self, factor: float) -> None:
        if replay := self._feed.replay():
            self._feed.control(speed=replay["speed"] * factor)
            self._fill()

    def action_seek(self, direction: int) -> None:
        """Seek back or forward by a twentieth of the recording."""
        if replay := self._feed.replay():
            self._feed.control(at=replay["at"] + direction * (replay["end"] - replay["begin"]) / 20)
            self._fill()


def watch(feed: Feed, replaced: Callable[[], bool] = lambda: False) -> int | None:
    """Show a run in the terminal until the user quits; returns the exit code.

    ``replaced``: whether another run is to be shown instead, asked every two seconds; None is returned then.
    """
    app: Any = MonitorApp(feed, replaced)
    app.run(mouse=False)
    return None if app.replaced else int(app.return_code or 0)
