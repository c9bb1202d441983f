"""The command line: ``lunarray`` and ``python -m lunarray``."""

import signal
import sys

from . import _native


def main() -> None:
    """Runs the command on ``sys.argv`` and ends the process with its exit code."""
    # Ctrl-C ends a command that has nothing to save at once, as without Python; the others set a handler of their own.
    signal.signal(signal.SIGINT, signal.SIG_DFL)
    sys.stdout.flush()
    sys.exit(_native.run_command(["lunarray", *sys.argv[1:]]))


if __name__ == "__main__":
    main()
