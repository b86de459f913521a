"""A home for a user who has none: a number without an entry among the users, or a ``HOME`` that is somebody else's.

Astropy cannot be imported then, and Dask and Numba would make a folder that is called ``~``. What is named here is what
Debian gives to users without a home: it is not there, so nothing is read from it, and nothing written to it.
"""

import os
from pathlib import Path

try:
    # Where this is refused, so is any look for a file in it.
    os.stat(f"{Path.home()}/.")
except (PermissionError, RuntimeError):
    os.environ["HOME"] = "/nonexistent"
except OSError:
    pass  # not there: nobody reads or writes anything in it
