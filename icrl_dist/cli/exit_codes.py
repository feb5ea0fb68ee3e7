"""Exit codes of ``icrl-dist``."""

import signal

OK, FAILED, USAGE, INTERRUPTED = 0, 1, 2, 130
UNREAD = 128 + signal.SIGPIPE
"""As a shell tells it of a command that nobody read to its end."""
