"""``python -m icrl_dist.cli``: the command line."""

import sys

from icrl_dist.cli.main import main

if __name__ == "__main__":
    sys.exit(main())
