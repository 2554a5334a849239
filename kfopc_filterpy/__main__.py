"""The command `kfopc`, which is also `python -m kfopc_filterpy`. Its modules are loaded where an interrupt is caught."""

import sys


def main() -> int:
    """Run the command line of this process and return the exit code: that of `commands.main`, or 130 if interrupted."""
    try:
        from . import commands

        return commands.main()
    except KeyboardInterrupt:
        print("kfopc: interrupted; each file is as it was, or was written whole", file=sys.stderr)
        return 130


if __name__ == "__main__":
    sys.exit(main())
