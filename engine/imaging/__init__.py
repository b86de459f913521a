"""Imaging: telescope PSF, dithered exposures and their noise, drizzle, and the observation that comes out."""
