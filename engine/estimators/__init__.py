"""Estimators of the host: a Sersic profile behind the lens, found in several ways.

:mod:`.image` is the posterior of the parametric fit. The others fit sources drawn from a chain: :mod:`.draws` is what
they are given, :mod:`.refit` fits every draw by every estimator, :mod:`.summaries` turns the fits into means and
deviations. They differ in the sum of squares that a profile is to minimise, each in a module of its own:

========================  ==========================================================================
:mod:`.paper`             unweighted on the drawn source map, as GALFIT without a sigma image
:mod:`.covariance`        on the drawn source map, weighted by the posterior covariance of the source
:mod:`.projected`         image-plane chi^2 of the profile on the source grid
:mod:`.image`             image-plane chi^2 of the ray-traced profile itself: no grid, no regularisation
========================  ==========================================================================

:mod:`.aperture` measures the maps without a profile; :mod:`.least_squares` is the bounded fit of many draws at once.
"""
