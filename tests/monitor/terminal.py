"""Drives the terminal view without a terminal."""

import asyncio

from icrl_dist.monitor.screen import MonitorApp


def shown(app, name):
    return app.screen.query_one(f"#{name}").lines


def text(app, name):
    return "\n".join(shown(app, name))


def rows(app, name):
    """The first cell of every row."""
    return [line.split("  ")[0].strip() for line in shown(app, name)[2:]]


def drive(feed, script, size=(130, 44)):
    """Run the view without a terminal while ``script(app, press)`` acts."""

    async def act():
        app = MonitorApp(feed)
        async with app.run_test(size=size) as pilot:

            async def press(*keys):
                await pilot.press(*keys)
                app.update_view()
                await pilot.pause()

            await press()
            await script(app, press)
        return app

    return asyncio.run(act())
