"""One image by several codes, and their answers as COOLEST."""

from __future__ import annotations

import json
import math
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from coolest.template.json import JSONSerializer
from lenstronomy.Util.coolest_interface import create_lenstronomy_from_coolest
from typer.testing import CliRunner

from benchmarks.peers import interpreter
from engine import Host, Realization, simulate_realization, write_observation
from engine.codes.answer import CodeAnswer
from engine.codes.by_autolens import fit_with_autolens
from engine.codes.by_lenstronomy import LenstronomyImages
from engine.codes.coolest import write_coolest
from engine.codes.joint_fit import Task, fitted
from engine.parametric.fit import ParametricFit, fit_parametric
from engine.simulation.simulate import Simulation
from service.cli.app import app
from tests.engine.conftest import cut

PIXELS = 48
DRAWN_OTHERWISE, RADII_OTHERWISE = 0.1, 1e-3
"""Of magnitudes and Einstein radii: other codes average light over a pixel before a PSF in which that is done already.

It makes 0.05 magnitudes and 3e-4 here, both in lenstronomy and in PyAutoLens.
"""


@pytest.fixture(scope="module")
def ring() -> Task:
    """A host without AGN behind HE0435's deflector, convolved with one PSF as other codes have it: a second a fit."""
    system = replace(cut(pixels=PIXELS), agn=(), deflector=None)
    simulation = simulate_realization(
        Realization(system=system, l_eta=1.0, host=Host(n=1.5, r_eff=0.3, magnitude=21.0))
    )
    seen = replace(simulation.observation, response=None, covariance=None)
    scene = simulation.scene
    noise = np.random.default_rng(0).normal(0.0, seen.noise)
    observation = replace(seen, image=seen.optics.sersic_image(scene.host, scene.lens) + noise)
    fit = fit_parametric(observation, agn_images=0, deflector=False)
    return Task(observation, fit.sigma, fit)


@pytest.fixture(scope="module")
def by_lenstronomy(ring: Task) -> CodeAnswer:
    return fitted(ring, "lenstronomy", "1", LenstronomyImages(ring))


def test_columns_of_lenstronomy_hold_the_light_of_ours(simulation: Simulation, fit: ParametricFit) -> None:
    task = Task(replace(simulation.observation, response=None, covariance=None), fit.sigma, fit)
    space, values = task.space, task.start()
    columns = LenstronomyImages(task)(space, values)
    assert columns.shape == (simulation.observation.image.size, space.amplitudes)
    optics, lens, host = task.observation.optics, space.lens(values), space.host(values)
    # Its arcs differ by what 4 x 4 rays and a PSF on pixels leave; their light by less.
    assert columns[:, -2].sum() == pytest.approx(optics.sersic_image(host, lens).sum(), rel=3e-3)
    for k, (x, y) in enumerate(space.agn(values)):
        ours = optics.point_source(float(x), float(y))
        assert columns[:, k].sum() == pytest.approx(ours.sum(), rel=3e-3)
        brightest = np.unravel_index(np.argmax(columns[:, k]), ours.shape)
        assert np.hypot(*np.subtract(brightest, np.unravel_index(np.argmax(ours), ours.shape))) < 1.5


def test_a_fit_finds_what_the_columns_were_made_with(ring: Task) -> None:
    images, space = LenstronomyImages(ring), ring.space
    truth = ring.start()
    flux = ring.fit.host.flux
    image = (images(space, truth) @ np.array([flux, 0.01])).reshape(ring.observation.shape)
    made = Task(replace(ring.observation, image=image), ring.sigma, ring.fit)
    # It begins two deviations away from what ``fit`` says, so that the truth is put there less these.
    answer = fitted(_begun_elsewhere(made), "lenstronomy", "1", images)
    lens, host = space.lens(truth), space.host(truth)
    for name in ("theta_E", "q", "slope"):
        # Without noise a tenth of the error: the priors pull by less than that.
        assert getattr(answer.lens, name) == pytest.approx(getattr(lens, name), abs=0.1 * answer.errors[name])
    assert answer.host.r_eff == pytest.approx(host.r_eff, abs=0.1 * answer.errors["r_eff"])
    assert answer.host.n == pytest.approx(host.n, abs=0.1 * answer.errors["n"])
    assert answer.host.flux == pytest.approx(flux, rel=0.1 * answer.errors["magnitude"])
    assert answer.background == pytest.approx(0.01, abs=1e-3)
    assert answer.chi2_per_dof < 0.01


def _begun_elsewhere(task: Task) -> Task:
    host = task.fit.host
    return Task(task.observation, task.sigma, replace(task.fit, host=replace(host, r_eff=0.9 * host.r_eff)))


def test_two_codes_agree_on_a_ring_as_far_as_they_draw_the_same(ring: Task, by_lenstronomy: CodeAnswer) -> None:
    fit, found = ring.fit, by_lenstronomy
    assert found.evaluations > 0
    assert 0.9 < found.chi2_per_dof < 1.2
    assert found.magnitude == pytest.approx(21.0, abs=DRAWN_OTHERWISE)
    assert found.lens.theta_E == pytest.approx(fit.lens.theta_E, rel=RADII_OTHERWISE)
    ours = dict(zip(fit.lens_names, np.sqrt(np.diag(fit.lens_covariance)), strict=True))
    for name in ("theta_E", "slope"):
        # Ours hold besides that neighbouring pixels share the error of a stamp.
        assert 0.3 * ours[name] < found.errors[name] < 1.1 * ours[name]


@pytest.mark.parametrize("shear", [(0.0, 0.0), (0.03, -0.05)])
def test_coolest_is_read_by_its_own_reader_and_means_the_same_to_lenstronomy(
    ring: Task,
    by_lenstronomy: CodeAnswer,
    shear: tuple[float, float],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.chdir(tmp_path)  # where lenstronomy looks for the planes
    lens = replace(by_lenstronomy.lens, gamma1=shear[0], gamma2=shear[1])
    (path,) = write_coolest(tmp_path, ring, [replace(by_lenstronomy, lens=lens)])
    model = JSONSerializer(str(path.with_suffix("")), check_external_files=True).load(skip_jsonpickle=True)
    assert model.mode == "MAP"
    assert model.observation.pixels.pixel_size == pytest.approx(ring.observation.pixel_scale)
    assert model.likelihoods[0].get_mask_pixels().sum() == np.isfinite(ring.sigma).sum()
    psf, _ = model.instrument.psf.pixels.fits_file.read()
    np.testing.assert_array_equal(psf, ring.fit.psf)
    read: dict[str, Any] = create_lenstronomy_from_coolest(str(path.with_suffix("")), use_epl=True)
    (kwargs, *rest) = sorted(read["kwargs_result"]["kwargs_lens"], key=len, reverse=True)
    # lenstronomy's own x runs against the columns; what does not depend on that has to be the same.
    assert kwargs["theta_E"] == pytest.approx(lens.theta_E)
    assert kwargs["gamma"] == pytest.approx(lens.slope)
    assert math.hypot(kwargs["e1"], kwargs["e2"]) == pytest.approx((1 - lens.q) / (1 + lens.q))
    if any(shear):
        assert math.hypot(*rest[0].values()) == pytest.approx(math.hypot(*shear))


def test_the_command_says_what_each_code_finds_and_who_is_absent(ring: Task, tmp_path: Path) -> None:
    image, out, folder = tmp_path / "ring.fits", tmp_path / "out.json", tmp_path / "coolest"
    write_observation(image, ring.observation)
    options = ["--agn-images", "0", "--json", str(out), "--folder", str(folder), "--autolens", sys.executable]
    done = CliRunner().invoke(app, ["compare-codes", str(image), *options])
    assert done.exit_code == 0, done.output
    found = json.loads(out.read_text())
    assert [answer["code"] for answer in found["answers"]] == ["hostlens", "lenstronomy"]
    for answer in found["answers"]:
        assert answer["magnitude"] == pytest.approx(21.0, abs=DRAWN_OTHERWISE)
    # This Python has no PyAutoLens: that is told, and takes nothing with it.
    assert "PyAutoLens cannot be imported: " in found["without_answer"]["PyAutoLens"]
    assert "No module named 'autolens'" in done.stdout
    assert sorted(path.name for path in folder.iterdir()) == [
        "hostlens.json", "image.fits", "lenstronomy.json", "mask.fits", "noise.fits", "psf.fits",
    ]  # fmt: skip


def test_autolens_finds_the_same_where_it_is_installed(ring: Task) -> None:
    python = interpreter("autolens")
    if python is None:
        pytest.skip("PyAutoLens has an environment of its own, made by python -m benchmarks.peers")
    found = fit_with_autolens(ring, python)
    assert found.chi2_per_dof < 1.2
    assert found.magnitude == pytest.approx(21.0, abs=DRAWN_OTHERWISE)
    assert found.lens.theta_E == pytest.approx(ring.fit.lens.theta_E, rel=RADII_OTHERWISE)
