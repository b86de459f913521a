"""Regularised linear inversion of a lensed image onto a grid of source pixels, and its Bayesian evidence.

The data d on the mask (M pixels, covariance C) are modelled as ``B L s + U a``: L traces rays to the source grid
(:mod:`engine.source.lensing_matrix`), B is the PSF (:mod:`engine.imaging.optics`), U holds the AGN images, the
deflector and a background. The amplitudes a have a flat prior and are marginalised once per observation
(:mod:`.amplitudes`), after which

    ln Z = -1/2 (d^T P d - D^T A^-1 D) - 1/2 ln|A| + 1/2 ln|H| + n/2 ln lambda - 1/2 ln|C| - 1/2 ln|U^T C^-1 U|
           - (M - k)/2 ln 2 pi,                             P = C^-1 - C^-1 U (U^T C^-1 U)^-1 U^T C^-1,

with F = L^T (B^T P B) L, D = L^T (B^T P d), A = F + lambda H (:mod:`.evidence`; Suyu et al. 2006, eq. 19, and the
determinant lemma for the marginalised amplitudes).
"""
