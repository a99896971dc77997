"""Run the command: `python -m zakai`."""

import sys

from zakai.cli import main

if __name__ == "__main__":
    sys.exit(main())
