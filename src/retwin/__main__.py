"""The command `retwin`, and `python -m retwin`: Ctrl-C while it is imported is one line too."""

import os
import signal
from types import FrameType


def main() -> None:
    """Import the command line, which takes a while, and run it."""
    waits = signal.getsignal(signal.SIGINT) is signal.default_int_handler
    if waits:
        signal.signal(signal.SIGINT, _end)
    from retwin.cli import main as run

    if waits:
        signal.signal(signal.SIGINT, signal.default_int_handler)
    run()


def _end(number: int, frame: FrameType | None) -> None:
    """End at once: an exception within an import would be that of the imported module."""
    os.write(2, b"error: interrupted; nothing was done yet\n")
    os._exit(130)


if __name__ == "__main__":
    main()
