"""Kernels where nothing can be written: they import, they are read where they are, and only then are compiled anew."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from engine import compiled

WARNING = "compiled kernels are not kept"
KERNELS = {
    "own_kernels.py": "from engine.compiled import kernel\n\n\n@kernel\ndef twice(x):\n    return 2.0 * x\n",
    "other_kernels.py": "from engine.compiled import kernel\n\n\n@kernel\ndef thrice(x):\n    return 3.0 * x\n",
}


def kernels_in(folder: Path) -> Path:
    """A package of the engine's name with its way to compile and two kernels: the whole would be loaded each time."""
    (folder / "engine").mkdir()
    (folder / "engine" / "__init__.py").touch()
    shutil.copy(compiled.__file__, folder / "engine")
    for name, source in KERNELS.items():
        (folder / "engine" / name).write_text(source, encoding="utf-8")
    return folder


def restricted() -> list[str]:
    """A command before another, which then is of a user without an entry, who may read all and write nothing."""
    if os.geteuid() != 0:
        return []  # the copy is not writable for its owner either
    if shutil.which("setpriv") is None:
        pytest.skip("to be another user takes setpriv")
    rights = "-all,+dac_read_search"  # Python itself may lie where only root can read
    who = ["--reuid=12345", "--regid=12345", "--clear-groups"]
    return ["setpriv", *who, f"--inh-caps={rights}", f"--ambient-caps={rights}"]


def compiled_anew(folder: Path, **variables: str) -> tuple[str, int]:
    """What a process says that imports the copy and uses its kernel, and how many times it had to compile it."""
    code = (
        "from numba.core import event\n"
        "import os\n"
        "from engine.other_kernels import thrice\n"
        "from engine.own_kernels import twice\n"
        "with event.install_recorder('numba:compile') as seen:\n"
        "    print(twice(1.0), twice(2), os.environ.get('HOME'))\n"
        "print(len(seen.buffer) // 2)\n"
    )
    ended = subprocess.run(
        [*restricted(), sys.executable, "-c", code],
        env={"PATH": os.environ["PATH"], "PYTHONPATH": str(folder), **variables},
        cwd=folder,
        capture_output=True,
        text=True,
        timeout=300,
        check=False,
    )
    assert ended.returncode == 0, ended.stderr
    values, compiled = ended.stdout.splitlines()
    assert values.startswith("2.0 4.0")
    return ended.stderr, int(compiled)


def read_only(folder: Path) -> Path:
    for path in (folder, *folder.rglob("*")):
        path.chmod(0o555 if path.is_dir() else 0o444)
    return folder


@pytest.fixture
def installed(tmp_path: Path) -> Path:
    tmp_path.chmod(0o755)
    return kernels_in(tmp_path)


def test_without_a_place_kernels_are_compiled_in_memory_with_one_warning(installed: Path) -> None:
    said, compiled = compiled_anew(read_only(installed))  # no HOME, no entry among the users
    assert compiled == 2
    assert said.count(WARNING) == 1
    assert len(said.splitlines()) == 1
    assert not (installed / "~").exists()
    said, compiled = compiled_anew(installed, HOME="/nonexistent", NUMBA_CACHE_DIR="/nonexistent/cache")
    assert (compiled, said.count(WARNING)) == (2, 1)


def test_kernels_that_an_installation_has_compiled_are_read_where_nothing_can_be_written(installed: Path) -> None:
    warm = "from engine.own_kernels import twice; twice(1.0); twice(2)"
    environment = {**os.environ, "PYTHONPATH": str(installed)}
    subprocess.run([sys.executable, "-c", warm], env=environment, cwd=installed, check=True)
    assert list((installed / "engine" / "__pycache__").glob("own_kernels.twice*.nbi"))
    assert compiled_anew(read_only(installed), HOME="/nonexistent") == ("", 0)


def test_a_folder_that_is_named_is_used(installed: Path, tmp_path_factory: pytest.TempPathFactory) -> None:
    place = tmp_path_factory.mktemp("cache")
    for folder in (place, place.parent):
        folder.chmod(0o777)
    read_only(installed)
    assert compiled_anew(installed, NUMBA_CACHE_DIR=str(place)) == ("", 2)
    assert compiled_anew(installed, NUMBA_CACHE_DIR=str(place)) == ("", 0)


def test_a_cache_that_is_damaged_or_cannot_be_read_is_none(installed: Path, tmp_path: Path) -> None:
    """A file that was being written when the power failed is empty; nothing heals it but another."""
    place = tmp_path / "cache"
    place.mkdir(mode=0o777)
    place.chmod(0o777)
    assert compiled_anew(installed, NUMBA_CACHE_DIR=str(place))[1] == 2
    for file in place.rglob("*.nb[ic]"):
        file.write_bytes(b"")
    said, compiled = compiled_anew(installed, NUMBA_CACHE_DIR=str(place))
    assert compiled == 2
    assert "Traceback" not in said
    if os.geteuid() == 0:
        for file in place.rglob("*.nb[ic]"):
            file.unlink()
            file.mkdir()  # a stranger's, say
        assert compiled_anew(installed, NUMBA_CACHE_DIR=str(place))[1] == 2
