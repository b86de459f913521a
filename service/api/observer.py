"""Keeps an eye on the leader's heartbeat: whoever asks seldom could not tell whether it changes."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager, suppress
from threading import Event, Thread

from sqlalchemy.exc import SQLAlchemyError

from service.store.leadership import Leadership


@contextmanager
def observing(leadership: Leadership, every_s: float) -> Iterator[None]:
    """Look at the leader at regular times, in a thread of its own, while the context lasts."""
    stop = Event()

    def watch() -> None:
        while not stop.is_set():
            # Without a database there is nothing to see, and who asks is told so.
            with suppress(SQLAlchemyError):
                leadership.alive()
            stop.wait(every_s)

    Thread(target=watch, name="observer", daemon=True).start()
    try:
        yield
    finally:
        stop.set()
