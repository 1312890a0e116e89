"""Entry point of the command `overfly`: sets Ctrl-C to end the process without a traceback before heavy imports."""

import signal
import sys


def main() -> int:
    """Run the command; return the exit code."""
    if signal.getsignal(signal.SIGINT) is signal.default_int_handler:  # otherwise the parent ignores it
        signal.signal(signal.SIGINT, signal.SIG_DFL)
    from deploy.cli import main as run  # noqa: PLC0415  see above

    return run()


if __name__ == "__main__":
    sys.exit(main())
