"""Specifications: what a run is asked to do. Frozen, validated at the door, written and read as JSON.

Everything here is in the sky frame of :mod:`engine.conventions` (East/North arcsec, position angles East of North);
:mod:`engine.simulation.simulate.scene` turns a :class:`~engine.spec.realization.realization.Realization` into arrays.
"""
