"""``python -m service.dispatcher``: the dispatcher process, as the supervisor starts it."""

import gc
import os
import sys

from service.runtime import start

if __name__ == "__main__":
    start.begin()
    # Until everything is loaded; dispatch() turns it on again.
    gc.disable()
    # Asked for in plain, because to load what reads settings takes a tenth of the time that workers wait for.
    from service.dispatcher.cluster_process import end_prepared, prepare_host

    start.on_early_end(end_prepared)
    if os.environ.get("HOSTLENS_CLUSTER", "local") == "local" and "HOSTLENS_SCHEDULER_ADDRESS" not in os.environ:
        # Before all else, so that it loads while this process does; without this, dispatch() starts it.
        prepare_host()
    from service.runtime.settings import Settings, read_settings

    try:
        with start.refusing():
            settings = read_settings(Settings)
            from service.dispatcher.dispatch import dispatch

            sys.exit(dispatch(settings))
    finally:
        end_prepared()
