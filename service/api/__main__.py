"""``python -m service.api``: the API process, as the supervisor starts it."""

from service.runtime import start

if __name__ == "__main__":
    start.begin()
    from service.api.serve import serve
    from service.runtime.settings import read_settings

    with start.refusing():
        serve(read_settings())
