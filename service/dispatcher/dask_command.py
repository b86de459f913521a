"""``python -m service.dispatcher.dask_command``: Dask's own commands, which a signal ends well at any moment."""

import signal
import socket

from service.runtime import start


def run() -> None:
    """Run one of Dask's commands."""
    start.begin()
    came, told = socket.socketpair()
    for end in (came, told):
        end.setblocking(False)
    # Dask puts its own handlers in place of ours; here the signals are noted all the same.
    signal.set_wakeup_fd(told.fileno(), warn_on_full_buffer=False)
    from dask.__main__ import main  # noqa: PLC0415 - takes a while

    try:
        main()
    except RuntimeError:
        # What was told to stop while it started has failed to start.
        if not _stopped(came):
            raise


def _stopped(came: socket.socket) -> bool:
    try:
        return not set(start.STOPS).isdisjoint(came.recv(4096))
    except BlockingIOError:
        return False


# The nanny's workers import this module again when they are started.
if __name__ == "__main__":
    run()
