"""Where the command `overfly` begins: nothing heavy is imported before Ctrl-C ends the process without a traceback."""

import signal
import sys


def main() -> int:
    """Run the command; returns the exit code."""
    if signal.getsignal(signal.SIGINT) is signal.default_int_handler:  # else the parent has it ignored
        signal.signal(signal.SIGINT, signal.SIG_DFL)
    from deploy.cli import main as run  # noqa: PLC0415  see above

    return run()


if __name__ == "__main__":
    sys.exit(main())
