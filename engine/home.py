"""A home for a user who has none: a number without an entry among the users, and no ``HOME``.

Astropy cannot be imported then, and Dask and Numba would make a folder that is called ``~``. What is named here is what
Debian gives to users without a home: it is not there, so nothing is read from it, and nothing written to it.
"""

import os
from pathlib import Path

try:
    Path.home()
except RuntimeError:
    os.environ["HOME"] = "/nonexistent"
