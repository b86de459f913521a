"""A run that is asked for an error chooses the settings that keep it, or says that it cannot."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import pytest

from engine.error_target import first_settings, next_settings, not_kept
from engine.errors import SpecError
from engine.experiment import run
from engine.result import ErrorBudget, Estimate, NumericalError, Quantity
from engine.spec.analysis import PROFILES, Analysis
from engine.spec.realization import Realization, realization_from_dict

BASE = Analysis(max_error=0.02, estimators=("projected",))


def estimate(sd: float, grid: float, draws: float, *, name: str = "projected", known: bool = True) -> Estimate:
    """One whose magnitude errs as told."""
    nothing = NumericalError(0.0, 0.0, 0.0, 0.0, 0.0)
    budget = ErrorBudget(NumericalError(0.0, 0.0, grid, 0.0, draws), nothing, nothing) if known else None
    return Estimate(name, "wide", Quantity(20.5, sd), *[Quantity(1.0, 0.0)] * 7, 30, 0, 0, 0, 0, budget)  # type: ignore[arg-type]


def test_it_begins_with_the_walk_of_draft() -> None:
    first = first_settings(Analysis(profile="reference", max_error=0.02, draws=50, source_pixels=(24, 22)))
    assert {name: getattr(first, name) for name in PROFILES["draft"]} == PROFILES["draft"]
    assert (first.draws, first.source_pixels) == (50, (24, 22))


def test_where_the_error_is_kept_nothing_more_is_done() -> None:
    assert next_settings(first_settings(BASE), [estimate(0.08, 0.01, 0.0149)], 0.02) is None
    assert not_kept([estimate(0.08, 0.01, 0.0149)], 0.02) == ()


def test_settings_that_cannot_be_bettered_are_the_last() -> None:
    settings = first_settings(BASE)
    found = next_settings(settings, [estimate(0.08, 0.0205, 0.0)], 0.02)
    assert found is not None
    for _ in range(9):
        settings = found
        found = next_settings(settings, [estimate(3.0, 1.0, 0.5)], 0.001)
        if found is None:
            break
    assert found is None


def test_more_draws_come_with_a_chain_that_has_as_many_states() -> None:
    found = next_settings(first_settings(BASE), [estimate(0.3, 0.0, 0.055)], 0.02)
    assert found is not None
    # sd / sqrt(k) at nine tenths of what is allowed.
    assert found.draws == pytest.approx((0.3 / 0.018) ** 2, abs=1)
    assert found.walkers * found.chain_length > found.draws
    assert found.source_pixels == BASE.source_pixels


def test_a_grid_grows_until_its_error_which_falls_with_the_cells_is_small_enough() -> None:
    found = next_settings(first_settings(BASE), [estimate(0.02, 0.025, 0.0037)], 0.02)
    assert found is not None
    ny, nx = found.source_pixels
    assert 0.025 * (400 / (ny * nx)) <= 0.7 * 0.9 * 0.02 + 1e-12
    assert ny * nx < 2.5 * 400


def test_nothing_costs_more_than_reference() -> None:
    found = next_settings(first_settings(BASE), [estimate(3.0, 1.0, 0.5)], 0.001)
    assert found is not None
    reference = Analysis(profile="reference")
    cost = found.walkers * found.chain_length * (found.source_pixels[0] * found.source_pixels[1]) ** 1.5
    assert cost <= reference.walkers * reference.chain_length * 400**1.5 * (1 + 1e-9)
    assert found.draws <= 1000
    # What is reached by then is told, and what is not known too.
    (told,) = not_kept([estimate(3.0, 1.0, 0.5)], 0.001)
    assert told == "max_error: projected has a numerical error of 1.1 mag, 0.001 is asked for"
    assert not_kept([estimate(3.0, 0.0, 0.0, known=False)], 0.001) == (
        "max_error: the numerical error of projected could not be predicted",
    )


@pytest.mark.parametrize("wrong", [0.0, -0.1, 11.0, float("nan"), True, "0.02"])
def test_an_error_that_cannot_be_asked_for_is_refused(realization: Realization, wrong: object) -> None:
    document = realization.to_dict()
    document["analysis"]["max_error"] = wrong
    with pytest.raises(SpecError, match="max_error"):
        realization_from_dict(document)


def test_the_digest_covers_it_and_is_what_it_was_without(realization: Realization) -> None:
    assert "max_error" not in realization.to_dict()["analysis"]
    asked = replace(realization, analysis=replace(realization.analysis, max_error=0.02))
    assert asked.digest != realization.digest
    assert asked.observation_digest == realization.observation_digest
    assert realization_from_dict(asked.to_dict()) == asked


def test_a_run_goes_on_from_settings_to_settings_and_tells_what_it_came_to(
    realization: Realization, monkeypatch: pytest.MonkeyPatch
) -> None:
    tried: list[Analysis] = []

    def cheap(settings: Analysis, estimates: Sequence[Estimate], max_error: float) -> Analysis | None:
        """The next settings, with no more than twice the draws, once: what is really wanted takes minutes."""
        tried.append(settings)
        wanted = next_settings(settings, estimates, max_error)
        assert wanted is not None
        return replace(settings, draws=2 * settings.draws) if len(tried) == 1 else None

    monkeypatch.setattr("engine.reconstruction.next_settings", cheap)
    analysis = replace(realization.analysis, max_error=2e-4, estimators=("projected", "image"))
    found = run(replace(realization, analysis=analysis))
    projected = found.estimate("projected", "wide")
    assert [one.draws for one in tried] == [4, 8]
    assert (projected.draws, found.profile) == (8, None)
    # No error of 0.0002 mag with 8 draws and 12 x 12 nodes; `image` has less.
    told = [warning for warning in found.warnings if warning.startswith("max_error")]
    assert [warning.split(" has ")[0] for warning in told] == ["max_error: projected"]
    # Each stage is told once, with all the time that it took.
    names = [stage.stage for stage in found.stages]
    assert len(names) == len(set(names))
