"""The service of hostlens: grids in by REST, realizations out to Dask workers, biases kept in a database."""

from typing import Any


def __getattr__(name: str) -> Any:
    # Looked up where it is wanted: to search the installed distributions takes longer than the start of most processes
    # can be interrupted in.
    if name == "VERSION":
        from importlib.metadata import PackageNotFoundError, version  # noqa: PLC0415

        try:
            return version("hostlens")
        except PackageNotFoundError:  # a checkout on the path, not installed
            return "0+checkout"
    raise AttributeError(name)
