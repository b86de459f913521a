"""The image model of PyAutoLens (Nightingale et al. 2021) by the Python that it is installed for.

Its requirements are not those of hostlens, so it may live in an environment of its own. It has no point sources that
are seen through a PSF: the columns of AGN images are the moved stamps of hostlens.
"""

from __future__ import annotations

import json
import subprocess
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np

from engine.codes.answer import CodeAnswer
from engine.codes.joint_fit import Task, fitted
from engine.conventions import FloatArray
from engine.errors import EngineError
from engine.imaging.optics.stamp import StampOptics
from engine.lensing.power_law import PowerLawLens, deflection
from engine.light.sersic import SersicProfile, effective_brightness, profile_of
from engine.parametric.parameters import ParameterSpace
from engine.stages import Progress

_SUBPIXELS = 4
_PROBE = (0.7, 0.4)
"""In Einstein radii, where its deflection has to be ours."""
_SAME = 1e-3
"""Of an Einstein radius."""
_SAID = 600
"""Letters of what it said before it ended."""


class CodeFailedError(EngineError):
    """Another code ended, or does not mean by its parameters what is meant here."""


def fit_with_autolens(task: Task, python: Path, progress: Progress | None = None) -> CodeAnswer:
    """The best model of an image by PyAutoLens, as ``python`` has it; a CodeFailedError where it does not answer."""
    stamps = ("AGN images are moved stamps, as hostlens moves them",) if task.fit.agn else ()
    with _running(task, python) as images:
        images.require_same(task.fit.lens)
        return fitted(task, "PyAutoLens", images.version, images, limits=(*task.limits, *stamps), progress=progress)


class _Images:
    """Columns of a child process."""

    def __init__(self, task: Task, child: subprocess.Popen[bytes], said: Path) -> None:
        self._child, self._said = child, said
        self._points = StampOptics(task.fit.psf, task.observation.shape, task.observation.pixel_scale)
        self.version = self._read_line()

    def __call__(self, space: ParameterSpace, values: FloatArray) -> FloatArray:
        """Columns (ny nx, amplitudes) of a vector."""
        light = profile_of(values[space.deflector_slice]) if space.deflector else None
        ny, nx = self._points.shape
        wanted = {"lens": _lens(space.lens(values)), "deflector": _light(light), "host": _light(space.host(values))}
        extended = self._ask(wanted, (1 + space.deflector) * ny * nx).reshape(-1, ny * nx)
        points = [self._points.point_source(float(x), float(y)).ravel() for x, y in space.agn(values)]
        return np.stack([*points, *extended, np.ones(ny * nx)], axis=1)

    def require_same(self, lens: PowerLawLens) -> None:
        """Its deflection is that of the same lens here."""
        place = lens.theta_E * np.array(_PROBE) + np.array([lens.x, lens.y])
        theirs, ours = self._ask({"lens": _lens(lens), "probe": place.tolist()}, 2), np.array(_deflection(lens, place))
        if not np.abs(theirs - ours).max() < _SAME * lens.theta_E:
            raise CodeFailedError(f"PyAutoLens {self.version}: deflects by {theirs} where {ours} is meant")

    def _ask(self, model: dict[str, Any], numbers: int) -> FloatArray:
        assert self._child.stdin is not None  # noqa: S101 - opened below
        assert self._child.stdout is not None  # noqa: S101 - as above
        try:
            self._child.stdin.write(json.dumps(model).encode() + b"\n")
            self._child.stdin.flush()
            answer = self._child.stdout.read(8 * numbers)
        except BrokenPipeError:
            answer = b""
        if len(answer) != 8 * numbers:
            raise CodeFailedError(f"PyAutoLens ended: {self._last_words()}")
        return np.frombuffer(answer)

    def _read_line(self) -> str:
        assert self._child.stdout is not None  # noqa: S101 - as above
        line = self._child.stdout.readline().decode().strip()
        if not line:
            raise CodeFailedError(f"PyAutoLens cannot be imported: {self._last_words()}")
        return line

    def _last_words(self) -> str:
        return self._said.read_text(errors="replace")[-_SAID:].strip()


def _deflection(lens: PowerLawLens, place: FloatArray) -> list[float]:
    return [float(one[0]) for one in deflection(lens, place[:1], place[1:])]


def _lens(lens: PowerLawLens) -> dict[str, Any]:
    """A lens, with what it deflects by without shear: from that its Einstein radius is found there."""
    place = np.array([lens.x + lens.theta_E, lens.y + 0.1 * lens.theta_E])
    alone = replace(lens, gamma1=0.0, gamma2=0.0)
    return {**asdict(lens), "place": place.tolist(), "deflection": _deflection(alone, place)}


def _light(profile: SersicProfile | None) -> dict[str, float] | None:
    """A profile of unit flux."""
    if profile is None:
        return None
    return {**asdict(profile), "brightness": effective_brightness(profile)}


@contextmanager
def _running(task: Task, python: Path) -> Iterator[_Images]:
    script = Path(__file__).with_name("autolens_images.py")
    with tempfile.TemporaryDirectory() as folder:
        scene, said = Path(folder) / "scene.npz", Path(folder) / "said"
        observation = task.observation
        np.savez(scene, scale=observation.pixel_scale, shape=observation.shape, psf=task.fit.psf, subpixels=_SUBPIXELS)
        with (
            said.open("wb") as errors,
            subprocess.Popen(
                [python, script, scene], stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=errors, cwd=folder
            ) as child,
        ):
            try:
                yield _Images(task, child, said)
            finally:
                child.kill()
