"""Loads what every worker needs, in the process that workers are forked from; see :mod:`service.worker.fork_server`."""

import gc
import logging
import os
from importlib import import_module

# Next to nothing of it becomes garbage, and to look for that again and again takes a sixth of the time.
gc.disable()
needed = ["distributed.nanny", "distributed.worker", "service.runtime.logs", "service.worker.tasks"]
# Another task, as hostlens check has one, may do without the engine, which takes two thirds of the time.
if os.environ.get("HOSTLENS_TASK", "service.worker:execute") == "service.worker:execute":
    needed.append("engine")
for name in needed:
    try:
        found = import_module(name)
        for late in getattr(found, "__all__", ()):
            # The engine loads what computes when its name is first used: here, and not in each worker.
            getattr(found, late)
    except Exception:
        # Each worker tries again when it is greeted, and its answer tells the dispatcher what is wrong.
        logging.getLogger(__name__).exception("%s cannot be loaded", name)
gc.freeze()
gc.enable()
