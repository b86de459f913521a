"""The service of hostlens: grids in by REST, realizations out to Dask workers, biases kept in a database."""

from importlib.metadata import PackageNotFoundError, version

try:
    VERSION = version("hostlens")
except PackageNotFoundError:  # a checkout on the path, not installed
    VERSION = "0+checkout"
