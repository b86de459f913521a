"""Gravitational lensing by an elliptical power law with external shear: deflection, magnification, images."""
