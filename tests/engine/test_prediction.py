"""Predictions: the regression is the Gaussian process it says, its intervals cover, and what is far is said to be."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from engine import (
    NEAR,
    Analysis,
    EngineError,
    Host,
    LensTraits,
    Optics,
    Predictor,
    Realization,
    SimulatedRun,
    SpecError,
    measure_image,
    simulate_realization,
    traits_of,
    traits_of_image,
)
from engine.conventions import FloatArray
from engine.prediction.mixed import fit_grouped
from engine.prediction.model import BiasModel, Expected
from engine.prediction.traits import FEATURES, features

LENSES, EACH, KAPPA, TAU = 60, 3, 1.3, 0.05
TRAITS = LensTraits(
    camera="WFC3-IR_F160W", resolution=0.185, depth=29.4, configuration="quad", arc_magnitude=18.5, magnitude=21.0,
    agn_contrast=-0.5, theta_E=1.2, r_eff=0.4, n=2.0, l_eta=1.0,
)  # fmt: skip


def realization(seed: int = 0) -> Realization:
    host = Host(n=2.0, r_eff=0.39, magnitude=20.5)
    return Realization(
        system="HE0435", l_eta=1.0, host=host, seed=seed, analysis=Analysis(estimators=("image",))
    )  # fmt: skip


class TestTheGroupedRidge:
    """Beside a Gaussian process with a dense covariance."""

    @staticmethod
    def problem() -> tuple[FloatArray, ...]:
        rng = np.random.default_rng(1)
        group = np.repeat(np.arange(7), [1, 5, 3, 8, 2, 4, 6])
        phi = np.column_stack([np.ones(group.size), rng.normal(size=(group.size, 3))])
        effect, noise = rng.uniform(0.1, 0.5, group.size), rng.uniform(0.2, 0.6, group.size)
        return phi, rng.normal(size=group.size), np.array([3.0, 0.5, 0.7, 0.2]), group, effect, noise

    @staticmethod
    def dense(phi, y, amplitude, group, effect, noise):
        shared = np.where(group[:, None] == group[None, :], np.outer(effect, effect), 0.0)
        covariance = (phi * amplitude**2) @ phi.T + shared + np.diag(noise**2)
        mean = amplitude**2 * (phi.T @ np.linalg.solve(covariance, y))
        ln_determinant = np.linalg.slogdet(covariance)[1]
        ln_evidence = -0.5 * (y @ np.linalg.solve(covariance, y) + ln_determinant + len(y) * math.log(2.0 * math.pi))
        gain = (phi * amplitude**2).T
        return mean, np.diag(amplitude**2) - gain @ np.linalg.solve(covariance, gain.T), ln_evidence

    def test_has_the_evidence_and_posterior_of_the_process(self) -> None:
        given = self.problem()
        fitted, (mean, covariance, ln_evidence) = fit_grouped(*given), self.dense(*given)
        # Rounding of two ways to the same numbers.
        np.testing.assert_allclose(fitted.coefficients()[0], mean, atol=1e-12)
        np.testing.assert_allclose(fitted.coefficients()[1], covariance, atol=1e-12)
        assert fitted.ln_evidence == pytest.approx(ln_evidence, abs=1e-10)

    def test_leaves_a_lens_out_as_if_it_had_never_been_there(self) -> None:
        phi, y, amplitude, group, effect, noise = self.problem()
        left, others = fit_grouped(phi, y, amplitude, group, effect, noise), group != 3
        mean, covariance, _ = self.dense(
            phi[others], y[others], amplitude, group[others], effect[others], noise[others]
        )
        np.testing.assert_allclose(left.coefficients(3)[0], mean, atol=1e-12)
        np.testing.assert_allclose(left.coefficients(3)[1], covariance, atol=1e-12)


def drawn(rng: np.random.Generator, lenses: int, each: int, tau: float = TAU) -> tuple[FloatArray, ...]:
    """Runs of lenses whose biases and deviations are functions of two features, beside what is their own."""
    lens = np.repeat(np.arange(lenses), each)
    x = rng.normal(size=(lenses, 3))[lens]
    s = 0.03 * np.exp(0.6 * x[:, 0] - 0.2 * x[:, 1] + rng.normal(0.0, 0.2, lenses)[lens])
    own = rng.normal(0.0, tau, lenses)[lens]
    mean = 0.1 + 0.05 * x[:, 1]
    return x, mean + own + rng.normal(size=lens.size) * KAPPA * s, s, lens, mean + own


@pytest.fixture(scope="module")
def strangers() -> tuple[FloatArray, FloatArray, FloatArray, list[Expected]]:
    """What five models of other lenses say of strangers, a hundred each: y, its mean, s."""
    told: list[Expected] = []
    columns = []
    for number in range(5):
        model = BiasModel(*drawn(np.random.default_rng(20 + number), LENSES, EACH)[:4])
        x, y, s, _, mean = drawn(np.random.default_rng(30 + number), 100, 1)
        told += [model.expect(one, 0.9) for one in x]
        columns.append((y, mean, s))
    y, mean, s = np.concatenate(columns, axis=1)
    return y, mean, s, told


class TestIntervals:
    def test_of_one_image_cover_lenses_that_were_not_there(self, strangers) -> None:
        y, _, _, told = strangers
        inside = np.mean([one.low <= value <= one.high for one, value in zip(told, y, strict=True)])
        # 500 strangers count to 1.3 %, and five times 60 lenses know the quantile to 1.7 %.
        assert inside == pytest.approx(0.9, abs=0.045)

    def test_are_hardly_wider_than_those_of_who_knows_each_lens(self, strangers) -> None:
        _, _, s, told = strangers
        oracle = 2.0 * 1.645 * np.sqrt(TAU**2 + (KAPPA * s) ** 2)
        assert 0.9 < np.mean([one.high - one.low for one in told]) / oracle.mean() < 1.2

    def test_of_the_mean_cover_the_mean_and_not_the_scatter(self, strangers) -> None:
        _, mean, s, told = strangers
        inside = np.mean([one.mean_low <= value <= one.mean_high for one, value in zip(told, mean, strict=True)])
        assert inside == pytest.approx(0.9, abs=0.045)
        faint = s > np.quantile(s, 0.8)
        widths = np.array([(one.mean_high - one.mean_low, one.high - one.low) for one in told])[faint]
        assert np.median(widths[:, 0] / widths[:, 1]) < 0.8

    def test_the_scatter_is_that_of_one_image(self, strangers) -> None:
        _, _, s, told = strangers
        # 180 runs know a deviation to 5 %, beside what lenses differ.
        assert np.exp(np.mean(np.log([one.scatter for one in told] / s))) == pytest.approx(KAPPA, rel=0.15)

    def test_few_lenses_are_believed_less(self) -> None:
        x, y, s, lens, _ = drawn(np.random.default_rng(4), 6, 20)
        few, many = BiasModel(x, y, s, lens), BiasModel(*drawn(np.random.default_rng(4), 60, 20)[:4])
        at = np.zeros(3)
        told, sure = few.expect(at, 0.9), many.expect(at, 0.9)
        assert told.mean_high - told.mean_low > 1.2 * (sure.mean_high - sure.mean_low)

    def test_three_lenses_are_refused(self) -> None:
        with pytest.raises(ValueError, match="lenses: got 3, allowed are 4 at least"):
            BiasModel(*drawn(np.random.default_rng(5), 3, 10)[:4])


def runs(number: int = 40) -> list[SimulatedRun]:
    rng = np.random.default_rng(6)
    found = []
    for place in range(number):
        traits = replace(
            TRAITS, r_eff=float(rng.uniform(0.3, 0.6)), n=float(rng.uniform(1.5, 4.0)), depth=float(rng.uniform(29, 30))
        )
        sd = 20.0 / traits.arc_snr
        answer = {name: (float(rng.normal(0.0, sd)), sd) for name in ("magnitude", "r_eff", "n")}
        fixed = {**answer, "n": (0.0, 0.0)}
        found.append(
            SimulatedRun(f"run-{place}", f"lens-{place}", traits, {"image_wide": answer, "image_fixed": fixed})
        )
    return found


@pytest.fixture(scope="module")
def predictor() -> Predictor:
    return Predictor(runs())


class TestThePredictor:
    def test_a_lens_as_the_runs_is_near_and_its_runs_are_named(self, predictor: Predictor) -> None:
        found = predictor.predict(runs()[7].traits, "image_wide")
        assert (found.run_ids[0], found.nearest_lens, found.distance) == ("run-7", "lens-7", 0.0)
        assert (found.runs, found.lenses, found.extrapolating) == (40, 40, False)

    @pytest.mark.parametrize(
        ("change", "feature"),
        [
            ({"n": 8.0}, "n"),
            ({"configuration": "double", "agn_contrast": -4.0}, "agn_contrast"),
            ({"defocus_nm": 20.0}, "psf"),
            ({"jitter": 0.006}, "psf"),
            ({"theta_E": 4.0}, "theta_E"),
            ({"l_eta": 1.6}, "l_eta"),
        ],
    )
    def test_a_lens_like_none_is_said_to_be_extrapolated(
        self, predictor: Predictor, change: dict[str, object], feature: str
    ) -> None:
        found = predictor.predict(replace(TRAITS, **change), "image_wide")  # type: ignore[arg-type]
        assert found.extrapolating
        assert found.distance > NEAR
        assert max(found.differences, key=lambda name: abs(found.differences[name])) == feature

    def test_more_exposures_lower_the_scatter_as_the_runs_show(self, predictor: Predictor) -> None:
        scatters = []
        for factor in (1.0, 2.0):
            told = predictor.predict(TRAITS.deeper(factor), "image_wide").quantities["magnitude"]
            assert told is not None
            scatters.append(told.scatter.expected)
        # Here the deviation is one over S/N, which exposures raise by their root.
        assert scatters[0] / scatters[1] == pytest.approx(math.sqrt(2.0), rel=0.05)

    def test_what_is_held_fixed_is_not_predicted(self, predictor: Predictor) -> None:
        found = predictor.predict(TRAITS, "image_fixed").quantities
        assert found["n"] is None
        assert found["magnitude"] is not None

    def test_radii_and_indices_stay_positive(self, predictor: Predictor) -> None:
        told = predictor.predict(TRAITS.deeper(1e-3), "image_wide", 0.99).quantities["n"]
        assert told is not None
        assert TRAITS.n + told.measurement.low > 0.0

    def test_what_nobody_ran_is_refused_by_name(self, predictor: Predictor) -> None:
        with pytest.raises(SpecError, match=r"estimators: got 'paper_wide'.*\['image_fixed', 'image_wide'\]"):
            predictor.predict(TRAITS, "paper_wide")
        with pytest.raises(SpecError, match=r"level: got 1.0, allowed is a probability from 0.5 to 0.99"):
            predictor.predict(TRAITS, "image_wide", 1.0)


class TestTraits:
    def test_are_those_of_the_simulation(self) -> None:
        simulation, found = simulate_realization(realization()), traits_of(realization())
        # Rendered on native pixels instead of finer ones.
        assert found.arc_magnitude == pytest.approx(simulation.arc_magnitude, abs=0.03)
        flux = sum(source.flux for source in simulation.scene.agn)
        contrast = -2.5 * math.log10(flux) + simulation.scene.camera.zero_point - simulation.arc_magnitude
        assert found.agn_contrast == pytest.approx(contrast, abs=0.03)

    def test_an_image_tells_what_was_simulated(self) -> None:
        simulation, true = simulate_realization(realization()), traits_of(realization())
        found = traits_of_image(measure_image(simulation.observation, inversion=False))
        assert (found.camera, found.configuration, found.resolution) == (true.camera, "quad", true.resolution)
        # A bright host, known to some hundredths; light of deflector and AGN is everywhere in the field.
        assert found.arc_magnitude == pytest.approx(true.arc_magnitude, abs=0.05)
        assert found.depth == pytest.approx(true.depth, abs=0.25)
        assert np.linalg.norm(features(found) - features(true)) < 0.3 * NEAR

    def test_exposures_count_by_their_root(self) -> None:
        found = TRAITS.deeper(4.0)
        assert found.depth - TRAITS.depth == pytest.approx(2.5 * math.log10(2.0), abs=1e-12)
        assert found.arc_snr == pytest.approx(2.0 * TRAITS.arc_snr, rel=1e-12)
        longer = replace(realization(), noise_level="handbook")
        assert traits_of(longer, 18.0).deeper(1.0) == traits_of(longer, 18.0)

    def test_unknown_optics_are_a_feature(self) -> None:
        spoilt = replace(realization(), optics=Optics(defocus_nm=20.0))
        place = FEATURES.index("psf")
        assert features(traits_of(spoilt, 18.0))[place] > 1.0
        assert features(traits_of(realization(), 18.0))[place] == 0.0

    @pytest.mark.parametrize(
        ("change", "told"),
        [
            ({"n": 11.0}, "n: got 11.0, allowed is a number from 0.3 to 10"),
            ({"r_eff": 0.0}, "r_eff: got 0.0"),
            ({"arc_magnitude": math.nan}, "arc_magnitude: got nan"),
            (
                {"configuration": "triple"},
                r"configuration: got 'triple', allowed is one of \['quad', 'double', 'other'\]",
            ),
        ],
    )
    def test_what_is_no_lens_is_refused_by_field(self, change: dict[str, object], told: str) -> None:
        with pytest.raises(EngineError, match=told):
            replace(TRAITS, **change)  # type: ignore[arg-type]
