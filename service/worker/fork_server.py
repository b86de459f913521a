"""Where the workers of this machine come from: a process that has loaded what they need and is forked for each.

To load the engine and Dask takes seconds of a core. Here it is done once, beside the start of the dispatcher itself, so
that a worker that died, or all of them after a kill of the dispatcher, are there again in a fraction of that.
"""

from __future__ import annotations

import os
import signal
from contextlib import suppress
from multiprocessing import forkserver

ONE_THREAD = {f"{name}_NUM_THREADS": 1 for name in ("OMP", "OPENBLAS", "MKL", "NUMEXPR", "NUMBA")}
"""Environment of a worker: the queue keeps its cores busy, and threads below a run would only fight for them."""


def open_nursery() -> None:
    """Start the process, which then loads what workers need while this one goes on; it ends with this one.

    It computes nothing and has one thread, so that what is forked from it is whole.
    """
    # Libraries read these when they are loaded, which for the workers is before Dask's nanny can set them.
    os.environ.update({name: str(threads) for name, threads in ONE_THREAD.items()})
    forkserver.set_forkserver_preload(["service.worker.preload"])
    forkserver.ensure_running()


def close_nursery() -> None:
    """End the process at once: while it still loads it would not notice that this one has ended, for seconds."""
    number = forkserver._forkserver._forkserver_pid  # type: ignore[attr-defined]  # there is no public way
    if number is not None:
        with suppress(ProcessLookupError):
            os.kill(number, signal.SIGKILL)
