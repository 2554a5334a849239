"""The command `kfopc`, also as `python -m kfopc_filterpy`. An interrupt is caught while its modules load, too."""

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
