"""`python -m kfopc_filterpy` is the command `kfopc`."""

import sys

from .commands import main

if __name__ == "__main__":
    sys.exit(main())
