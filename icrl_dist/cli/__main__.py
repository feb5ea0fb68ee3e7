"""``python -m icrl_dist.cli``: the command line."""

import os
import sys

if __name__ == "__main__":
    # ``-m`` puts the current folder first: a file ``random.py`` of the user there would be imported in place of Python's own.
    root = os.path.dirname(os.path.dirname(os.path.dirname(os.path.realpath(__file__))))  # noqa: PTH120
    if not sys.flags.safe_path and os.path.realpath(sys.path[0]) != root:
        del sys.path[0]
    from icrl_dist.cli.main import main

    sys.exit(main())
