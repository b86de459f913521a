"""A small version of ``python -m benchmarks.starts``: a quad, a double, a small UVIS double, without the truth."""

import pytest

from benchmarks.starts import land, paper_runs


@pytest.mark.parametrize(
    ("system", "l_eta", "n", "bounds"),
    [
        # Four times the largest errors of the whole benchmark for that system and magnitude.
        ("WFI2033", 1.2, 4.0, (2e-3, 0.02, 0.05, 0.1)),
        ("HE1104", 0.8, 2.0, (2e-3, 0.02, 0.05, 0.1)),
        # That a fit lands there too is seen in tests/hard_cases/test_hosts.py, in a smaller field.
        pytest.param("HS2209", 1.0, 2.0, (4e-3, 0.05, 0.2, 0.2), marks=pytest.mark.long),
    ],
)
def test_the_start_lands_beside_the_truth(
    system: str, l_eta: float, n: float, bounds: tuple[float, float, float, float]
) -> None:
    runs = [run for run in paper_runs([system]) if run.l_eta == l_eta and run.host.n == n]
    landing = land(min(runs, key=lambda run: run.host.magnitude), blind=False)
    assert landing.errors is not None, landing.note
    for error, bound in zip(landing.errors, bounds, strict=True):
        assert abs(error) < bound, landing
