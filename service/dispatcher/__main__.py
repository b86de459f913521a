"""``python -m service.dispatcher``: the dispatcher process, as the supervisor starts it."""

import sys

from service.settings import Settings

# Dask's workers import this module again when they are spawned; only the process itself dispatches.
if __name__ == "__main__":
    from service.dispatcher.process import dispatch

    sys.exit(dispatch(Settings()))
