"""Peers with requirements that ours would not bear: each in an environment of its own beside this file.

``python -m benchmarks.peers`` makes the environments (a few minutes, half a gigabyte each); a benchmark asks
:func:`interpreter` and says so where there is none.
"""

import os
import shutil
import subprocess
import sys
from pathlib import Path

PEERS = ("autolens",)
_HERE = Path(__file__).parent


def interpreter(peer: str) -> Path | None:
    """Python of the environment of a peer, or None where it has not been made."""
    environment = _HERE / f".venv-{peer}"
    return environment / "bin" / "python" if (environment / "prepared").exists() else None


def _newest_python() -> str:
    """A Python 3.12 where there is one, since the newest releases of peers ask for it; else our own."""
    pyenv = Path(os.environ.get("PYENV_ROOT", Path.home() / ".pyenv")) / "versions"
    candidates = [shutil.which("python3.12"), *map(str, sorted(pyenv.glob("3.12*/bin/python3.12")))]
    for candidate in candidates:
        # A shim may stand for a version that is not there.
        if candidate and subprocess.run([candidate, "-c", ""], capture_output=True, check=False).returncode == 0:
            return candidate
    return sys.executable


def prepare(peer: str) -> Path:
    """Make the environment of a peer from its pinned requirements, once."""
    environment = _HERE / f".venv-{peer}"
    python = environment / "bin" / "python"
    if interpreter(peer) is None:
        subprocess.run([_newest_python(), "-m", "venv", "--clear", str(environment)], check=True)
        requirements = str(_HERE / f"{peer}.txt")
        subprocess.run([str(python), "-m", "pip", "install", "--quiet", "-r", requirements], check=True)
        (environment / "prepared").touch()
    return python


def missing(peer: str) -> str:
    """What to say where a peer has not been prepared."""
    return f"{peer}: not prepared, run '{Path(sys.executable).name} -m benchmarks.peers'"
