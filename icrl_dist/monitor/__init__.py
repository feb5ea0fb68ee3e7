"""The live view of a run in a terminal and in a browser, and ``icrl-dist play``; ``serve`` serves the pages of both."""
