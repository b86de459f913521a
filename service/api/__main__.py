"""``python -m service.api``: the API process, as the supervisor starts it."""

import gc

from service.runtime import start

if __name__ == "__main__":
    start.begin()
    # Until everything is loaded; serve() turns it on again.
    gc.disable()
    from service.api.serve import serve
    from service.runtime.settings import read_settings

    with start.refusing():
        serve(read_settings())
