"""The command line: ``hostlens``, ``python -m service``."""

import signal
import sys

from service.runtime import start

_SERVICES = frozenset({"serve", "api", "dispatcher", "scheduler", "worker"})


def main() -> None:
    """Run a command."""
    service = sys.argv[1:2] and sys.argv[1] in _SERVICES
    start.begin(service=bool(service))
    from service.cli.app import app  # noqa: PLC0415 - takes a while

    try:
        if not service:
            start.interruptible()
        app()
    except KeyboardInterrupt:
        sys.exit(128 + signal.SIGINT)
    finally:
        # CPython takes note of an interrupt in code that was compiled from a string, as dataclasses are made, and ends
        # by the signal whatever becomes of it; the next such code clears the note.
        exec("")  # noqa: S102 - an empty text
        start.finish(service=bool(service))


if __name__ == "__main__":
    main()
