"""Exit codes of ``icrl-dist``."""

import signal

OK, FAILED, USAGE, INTERRUPTED = 0, 1, 2, 130
BROKEN_PIPE = 128 + signal.SIGPIPE
"""The reader of standard output has closed it; the code that a shell reports for a process killed by SIGPIPE."""
