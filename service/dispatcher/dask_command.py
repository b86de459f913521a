"""``python -m service.dispatcher.dask_command``: Dask's own commands, which a signal ends well at any moment."""

from service import start

# The nanny's workers import this module again when they are started.
if __name__ == "__main__":
    start.begin()
    from dask.__main__ import main

    main()
