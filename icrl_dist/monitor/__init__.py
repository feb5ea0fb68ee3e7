"""The live view: terminal and browser.  Pages are served by ``serve``; ``play`` has a game of its own."""
