"""Loads what every worker needs, in the process that workers are forked from; see :mod:`service.dispatcher.nursery`."""

import logging

import distributed.nanny
import distributed.worker  # noqa: F401 - loaded for those who come after

import service.logs
import service.worker  # noqa: F401

try:
    import engine  # noqa: F401
except Exception:
    # Each worker tries again when it is greeted, and its answer tells the dispatcher what is wrong.
    logging.getLogger(__name__).exception("the engine cannot be loaded")
