"""What runs on a Dask worker, and the process that workers are forked from.

``service.worker:execute`` is the name by which deployments call the engine's task (``HOSTLENS_TASK``).
"""

from typing import Any


def __getattr__(name: str) -> Any:
    # Looked up where it is wanted: the process that workers are forked from is started before anything else is loaded.
    if name in {"execute", "warm_up"}:
        from service.worker import tasks  # noqa: PLC0415

        return getattr(tasks, name)
    raise AttributeError(name)
