"""``python -m service.dispatcher``: the dispatcher process, as the supervisor starts it."""

import sys

# Dask's workers import this module again when they are started; only the process itself dispatches.
if __name__ == "__main__":
    from service.settings import Settings

    settings = Settings()
    if settings.kind_of_cluster == "local":
        from service.dispatcher.nursery import open_nursery

        # Before all else, so that it loads while this process does; without this, dispatch() opens it.
        open_nursery()
    from service.dispatcher.process import dispatch

    sys.exit(dispatch(settings))
