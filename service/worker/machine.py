"""What a machine adds to the versions that a run was made with: another processor may round the last bit otherwise."""

from __future__ import annotations

import platform
from functools import cache


@cache
def machine() -> dict[str, str]:
    """The platform, and which of its kernels the library of linear algebra has chosen for the processor."""
    from threadpoolctl import threadpool_info  # noqa: PLC0415 - a worker loads the engine late, and this with it

    found = {"platform": f"{platform.system()} {platform.machine()}"}
    kernels = {str(pool.get("architecture")) for pool in threadpool_info() if pool["user_api"] == "blas"}
    return found | ({"blas": " ".join(sorted(kernels))} if kernels else {})
