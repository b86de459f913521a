"""A dispatcher as on another machine whose clock is wrong: ``python -m tests.service.foreign_dispatcher HOURS``."""

import datetime
import os
import sys

# Dask's workers import this module again when they are started; only the process itself dispatches.
if __name__ == "__main__":
    from service.dispatcher import identity
    from service.domain import identifiers

    class Wrong(datetime.datetime):
        """The wall clock of that machine; what goes by at a steady pace is right everywhere."""

        @classmethod
        def now(cls, tz: datetime.tzinfo | None = None) -> datetime.datetime:  # type: ignore[override]
            return datetime.datetime.now(tz) + datetime.timedelta(hours=float(sys.argv[1]))

    identifiers.datetime = Wrong  # type: ignore[misc]
    # Or whoever looks would see that the process is dead: nothing is known of those elsewhere but their heartbeat.
    identity._place = lambda: f"elsewhere-{os.getpid()}"

    from service.dispatcher.dispatch import dispatch
    from service.runtime.settings import Settings

    sys.exit(dispatch(Settings()))
