"""`python -m beltrami_cli` is the console script `beltrami`."""

import sys

from beltrami_cli.cli import main

if __name__ == "__main__":
    sys.exit(main())
