"""``python -m service.api``: the API process, as the supervisor starts it."""

import gc

from service.runtime import start

if __name__ == "__main__":
    start.begin()
    # Until everything is loaded; serve() turns it on again.
    gc.disable()
    # Before what takes a second to load: a mistake is told at once.
    from service.runtime.settings import Settings, read_settings

    with start.refusing():
        settings = read_settings(Settings)
        from service.api.serve import serve

        serve(settings)
